-- Records by month: one table for five years would be too large to drop, to move or to vacuum. A month has a block of numbers of runs, and
-- the tables by run have a partition for each block. So a question for a run reads one partition, without its month.

-- Numbers of runs. A month has one block, or further ones where it is full.
CREATE TABLE month_block (
    first integer PRIMARY KEY,
    behind integer NOT NULL UNIQUE,
    month date NOT NULL CHECK (extract(day FROM month) = 1),
    CHECK (first < behind)
);
CREATE INDEX month_block_month ON month_block (month, first);

-- The begin of an archived run keeps what tells of runs that never came.
ALTER TABLE run ADD COLUMN archived_at timestamptz, ADD COLUMN archive text, ADD COLUMN numbering text;
CREATE INDEX run_archived ON run (id) WHERE archived_at IS NOT NULL;

-- The tables of today become the first partitions.
ALTER TABLE record RENAME TO record_before;
ALTER INDEX record_pkey RENAME TO record_before_pkey;
ALTER TABLE run_artefact RENAME TO run_artefact_before;
ALTER INDEX run_artefact_pkey RENAME TO run_artefact_before_pkey;
DROP INDEX run_artefact_sha256;
DROP POLICY own ON record_before;
DROP POLICY everything ON record_before;
DROP POLICY own ON run_artefact_before;
DROP POLICY everything ON run_artefact_before;
REVOKE ALL ON record_before, run_artefact_before FROM regrind_cell, regrind_reader;

CREATE TABLE record (
    run integer NOT NULL,
    seq integer NOT NULL,
    hash bytea NOT NULL,
    -- The text that was hashed, byte for byte: docs/journal.md.
    text text NOT NULL,
    PRIMARY KEY (run, seq)
) PARTITION BY RANGE (run);
CREATE TABLE run_artefact (
    run integer NOT NULL,
    name text NOT NULL,
    sha256 bytea NOT NULL,
    bytes bigint NOT NULL,
    PRIMARY KEY (run, name, sha256)
) PARTITION BY RANGE (run);

-- The partitions of a block. Rights are those of the whole tables: nobody reads a partition by itself.
CREATE FUNCTION make_partitions(of_first integer, of_behind integer) RETURNS void
LANGUAGE plpgsql SET search_path = regrind, pg_temp AS $$
BEGIN
    EXECUTE format('CREATE TABLE IF NOT EXISTS record_%s PARTITION OF record FOR VALUES FROM (%s) TO (%s)', of_first, of_first, of_behind);
    EXECUTE format('CREATE TABLE IF NOT EXISTS run_artefact_%s PARTITION OF run_artefact FOR VALUES FROM (%s) TO (%s)', of_first, of_first, of_behind);
    EXECUTE format('ALTER TABLE record_%s ENABLE ROW LEVEL SECURITY', of_first);
    EXECUTE format('ALTER TABLE run_artefact_%s ENABLE ROW LEVEL SECURITY', of_first);
END $$;

-- Makes the next block, for a month, with the sequence that gives its numbers: no cell waits for another one. Two million runs in a month are
-- two thousand cells that make a part in three quarters of an hour.
CREATE FUNCTION make_block(of_month date) RETURNS void
LANGUAGE plpgsql SET search_path = regrind, pg_temp SET lock_timeout = '500ms' AS $$
DECLARE
    begins integer;
    ends integer;
BEGIN
    -- One after the other, so that a block is made once. Nobody else can lock this table.
    LOCK TABLE month_block IN SHARE ROW EXCLUSIVE MODE;
    IF EXISTS (SELECT FROM month_block m WHERE m.month = of_month AND NOT is_full(m.first)) THEN
        RETURN;
    END IF;
    begins := (SELECT max(behind) FROM month_block);
    ends := begins + 2000000;
    PERFORM make_partitions(begins, ends);
    EXECUTE format('CREATE SEQUENCE month_%s AS integer MINVALUE %s MAXVALUE %s START %s', begins, begins, ends - 1, begins);
    INSERT INTO month_block (first, behind, month) VALUES (begins, ends, of_month);
END $$;

-- Whether the numbers of a block are used up. The first block has none: its runs were there before it.
CREATE FUNCTION is_full(of_block integer) RETURNS boolean LANGUAGE sql STABLE SET search_path = regrind, pg_temp AS $$
    SELECT coalesce((SELECT s.last_value = s.max_value FROM pg_sequences s WHERE s.schemaname = 'regrind' AND s.sequencename = 'month_' || of_block),
        NOT EXISTS (SELECT FROM pg_sequences s WHERE s.schemaname = 'regrind' AND s.sequencename = 'month_' || of_block))
$$;

-- Makes the block of a month in advance. Where readers are in the way, a later call makes it.
CREATE FUNCTION make_block_ahead(of_month date) RETURNS void
LANGUAGE plpgsql SET search_path = regrind, pg_temp AS $$
BEGIN
    IF NOT EXISTS (SELECT FROM month_block WHERE month = of_month) THEN
        PERFORM make_block(of_month);
    END IF;
EXCEPTION WHEN lock_not_available THEN
    NULL;
END $$;

-- Takes numbers for runs of a month, one behind the other. Answers with the first.
CREATE FUNCTION reserve_run_ids(at timestamptz, count integer) RETURNS integer
LANGUAGE plpgsql SET search_path = regrind, pg_temp AS $$
DECLARE
    of_month constant date := date_trunc('month', at AT TIME ZONE 'UTC');
    block text;
    taken integer;
BEGIN
    FOR k IN 1..3 LOOP
        block := (SELECT 'month_' || m.first FROM month_block m WHERE m.month = of_month AND NOT is_full(m.first) ORDER BY m.first LIMIT 1);
        BEGIN
            SELECT min(nextval(block::regclass)) INTO taken FROM generate_series(1, count) WHERE block IS NOT NULL;
        EXCEPTION WHEN sequence_generator_limit_exceeded THEN
            taken := NULL;
        END;
        EXIT WHEN taken IS NOT NULL;
        PERFORM make_block(of_month);
    END LOOP;
    RETURN taken;
END $$;

-- The runs of today, with what is there, in a block of their own.
DO $$
DECLARE
    behind_all constant integer := (SELECT coalesce(max(id), 0) + 1 FROM regrind.run);
BEGIN
    EXECUTE format('ALTER TABLE regrind.record ATTACH PARTITION regrind.record_before FOR VALUES FROM (0) TO (%s)', behind_all);
    EXECUTE format('ALTER TABLE regrind.run_artefact ATTACH PARTITION regrind.run_artefact_before FOR VALUES FROM (0) TO (%s)', behind_all);
    INSERT INTO regrind.month_block (first, behind, month)
        SELECT 0, behind_all, date_trunc('month', coalesce(max(arrived_at), now()) AT TIME ZONE 'UTC') FROM regrind.run;
    SET LOCAL search_path = regrind, pg_temp;
    PERFORM make_block(date_trunc('month', now() AT TIME ZONE 'UTC')::date);
    PERFORM make_block((date_trunc('month', now() AT TIME ZONE 'UTC') + interval '1 month')::date);
END $$;
ALTER TABLE run ALTER COLUMN id DROP IDENTITY;
ALTER TABLE run ALTER COLUMN id SET DEFAULT reserve_run_ids(now(), 1);

CREATE OR REPLACE FUNCTION open_run(of_name text) RETURNS TABLE (id integer, records integer, head bytea, is_ended boolean)
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
#variable_conflict use_column
DECLARE
    mine integer := must_be_a_cell();
BEGIN
    IF NOT EXISTS (SELECT FROM run r WHERE r.cell = mine AND r.name = of_name) THEN
        INSERT INTO run (id, cell, name) VALUES (reserve_run_ids(now(), 1), mine, of_name) ON CONFLICT (cell, name) DO NOTHING;
        IF FOUND THEN
            PERFORM count_usage(mine, 1, 0);
            PERFORM make_block_ahead((date_trunc('month', now() AT TIME ZONE 'UTC') + interval '1 month')::date);
        END IF;
    END IF;
    RETURN QUERY SELECT r.id, r.records, r.head, r.ended IS NOT NULL FROM run r WHERE r.cell = mine AND r.name = of_name;
END $$;

-- What is wrong with records that are to stand behind those of a run; null where nothing is. The chain is that of docs/journal.md.
CREATE OR REPLACE FUNCTION flaw_of(r run, from_seq integer, hashes bytea[], texts text[]) RETURNS text
LANGUAGE plpgsql SET search_path = regrind, pg_temp AS $$
DECLARE
    bad integer;
    its_part text := r.part;
BEGIN
    IF r.archived_at IS NOT NULL THEN
        RETURN format('the run was archived to %s; bring it back first: regrind plant unarchive', r.archive);
    END IF;
    IF cardinality(texts) = 0 OR cardinality(hashes) IS DISTINCT FROM cardinality(texts) THEN
        RETURN 'there is not one hash for each record';
    END IF;
    SELECT from_seq + min(n)::integer - 1 INTO bad FROM (
        SELECT n, hash, text, lag(hash, 1, r.head) OVER (ORDER BY n) AS before
        FROM unnest(hashes, texts) WITH ORDINALITY AS u (hash, text, n)
    ) c WHERE hash IS DISTINCT FROM
        sha256(convert_to('regrind journal record 1' || chr(10) || encode(before, 'hex') || chr(10) || text, 'UTF8'));
    IF bad IS NOT NULL THEN
        RETURN format('record %s does not follow the one before it, or its content is not what was hashed', bad);
    END IF;
    IF from_seq = 1 THEN
        its_part := texts[1]::json ->> 'part';
        IF texts[1]::json -> 'payload' ->> 'run' IS DISTINCT FROM r.name THEN
            RETURN format('record 1 begins another run than %s', r.name);
        END IF;
    END IF;
    SELECT from_seq + min(n)::integer - 1 INTO bad
        FROM unnest(texts) WITH ORDINALITY AS u (text, n), json_to_record(text::json) AS f (seq integer, kind text, part text)
        WHERE f.seq IS DISTINCT FROM from_seq + n - 1 OR left(f.part, 300) IS DISTINCT FROM left(its_part, 300) OR (f.kind = 'begin') <> (f.seq = 1)
            OR f.kind IS NULL OR (f.kind <> 'seal' AND r.ended IS NOT NULL);
    IF bad IS NOT NULL THEN
        RETURN format('record %s has another number or part than its place says, begins a second run, or stands behind the end', bad);
    END IF;
    RETURN NULL;
END $$;

-- The figures of an archived run are those that its folder proves.
CREATE FUNCTION keep_archived() RETURNS trigger LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
BEGIN
    IF TG_TABLE_NAME = 'cycle' THEN
        IF EXISTS (SELECT FROM run r WHERE r.id = coalesce(new.run, old.run) AND r.archived_at IS NOT NULL) THEN
            RETURN NULL;
        END IF;
        RETURN coalesce(new, old);
    END IF;
    PERFORM complain(old.name, 'a report refused', 'its figures are those of an archived run, which stay');
    RETURN NULL;
END $$;
CREATE TRIGGER keep_archived BEFORE UPDATE ON run FOR EACH ROW
    WHEN (old.archived_at IS NOT NULL AND new.archived_at IS NOT NULL AND (old.result, old.verdict, old.cycles, old.pv_um, old.rms_um, old.pv_limit_um,
        old.rms_limit_um, old.alarms, old.grinder, old.cmm, old.wheel, old.probe) IS DISTINCT FROM (new.result, new.verdict, new.cycles, new.pv_um,
        new.rms_um, new.pv_limit_um, new.rms_limit_um, new.alarms, new.grinder, new.cmm, new.wheel, new.probe)) EXECUTE FUNCTION keep_archived();
CREATE TRIGGER keep_archived BEFORE INSERT OR UPDATE OR DELETE ON cycle FOR EACH ROW EXECUTE FUNCTION keep_archived();

-- ---- archive -------------------------------------------------------------------------------------------------------------

-- Runs by month that are not archived. One that ended can be archived after a day: its seal comes behind its end.
CREATE VIEW archivable WITH (security_invoker = true) AS
SELECT r.id, c.name AS cell, r.name AS run, b.month, b.first AS block, r.ended IS NOT NULL AND r.arrived_at < now() - interval '1 day' AS is_over
FROM month_block b JOIN run r ON r.id >= b.first AND r.id < b.behind JOIN cell c ON c.id = r.cell
WHERE r.archived_at IS NULL AND r.records > 0;

-- Contents that archived runs named: they go, unless another run names them.
CREATE TABLE archived_content (sha256 bytea PRIMARY KEY);

-- Removes the records and the lists of files of the runs of a block that were archived. A block without other runs is dropped as a whole: its
-- tables must be free, so the caller tries again where readers and cells hold them, and nobody waits behind this for long. Answers with the
-- number of records.
CREATE FUNCTION remove_records(of_block integer) RETURNS bigint
LANGUAGE plpgsql SET search_path = regrind, pg_temp SET lock_timeout = '500ms' AS $$
DECLARE
    b month_block%ROWTYPE;
    is_past boolean;
    gone bigint;
BEGIN
    SELECT * INTO STRICT b FROM month_block m WHERE m.first = of_block;
    is_past := b.month < date_trunc('month', now() AT TIME ZONE 'UTC');
    IF NOT EXISTS (SELECT FROM run r WHERE r.id >= b.first AND r.id < b.behind AND (r.archived_at IS NOT NULL OR r.records = 0)) THEN
        RETURN 0;
    END IF;
    -- A run of which no record ever came is none. It begins anew if one comes.
    DELETE FROM cycle y USING run r WHERE y.run = r.id AND r.id >= b.first AND r.id < b.behind AND r.records = 0 AND r.began IS NULL AND is_past;
    DELETE FROM run r WHERE r.id >= b.first AND r.id < b.behind AND r.records = 0 AND r.began IS NULL AND is_past;
    UPDATE run r SET numbering = jsonb_build_object('payload', jsonb_build_object('content', jsonb_build_object(
            'number', e.text::jsonb #> '{payload,content,number}', 'before', e.text::jsonb #> '{payload,content,before}')))::text
        FROM record e WHERE e.run = r.id AND e.seq = 1 AND e.run >= b.first AND e.run < b.behind
            AND r.id >= b.first AND r.id < b.behind AND r.archived_at IS NOT NULL AND r.numbering IS NULL;
    INSERT INTO archived_content SELECT DISTINCT a.sha256 FROM run_artefact a JOIN run r ON r.id = a.run
        WHERE a.run >= b.first AND a.run < b.behind AND r.archived_at IS NOT NULL ON CONFLICT DO NOTHING;
    IF is_past AND NOT EXISTS (SELECT FROM run r WHERE r.id >= b.first AND r.id < b.behind AND r.archived_at IS NULL AND r.records > 0) THEN
        gone := (SELECT count(*) FROM record e WHERE e.run >= b.first AND e.run < b.behind);
        EXECUTE (SELECT coalesce(string_agg(format('DROP TABLE %s;', i.inhrelid::regclass), ' ' ORDER BY i.inhparent DESC), '')
            FROM pg_inherits i JOIN pg_class p ON p.oid = i.inhrelid
            WHERE i.inhparent IN ('record'::regclass, 'run_artefact'::regclass)
                AND pg_get_expr(p.relpartbound, p.oid) = format('FOR VALUES FROM (%s) TO (%s)', b.first, b.behind));
        RETURN gone;
    END IF;
    DELETE FROM run_artefact a USING run r WHERE r.id = a.run AND a.run >= b.first AND a.run < b.behind AND r.archived_at IS NOT NULL;
    WITH removed AS (DELETE FROM record e USING run r WHERE r.id = e.run AND e.run >= b.first AND e.run < b.behind AND r.archived_at IS NOT NULL RETURNING 1)
        SELECT count(*) INTO gone FROM removed;
    RETURN gone;
END $$;

-- Waits until whoever writes lists of files has finished: from then on each such writer sees what is in archived_content.
CREATE FUNCTION wait_for_writers() RETURNS void LANGUAGE plpgsql SET search_path = regrind, pg_temp SET lock_timeout = '500ms' AS $$
BEGIN
    LOCK TABLE run_artefact IN SHARE MODE;
END $$;

-- Keeps the contents that another run names, or that taught something.
CREATE FUNCTION keep_named_contents() RETURNS void LANGUAGE sql SET search_path = regrind, pg_temp AS $$
    DELETE FROM archived_content g WHERE EXISTS (SELECT FROM run_artefact a WHERE a.sha256 = g.sha256)
        OR EXISTS (SELECT FROM lesson l WHERE l.sha256 = g.sha256) OR EXISTS (SELECT FROM artefact a WHERE a.sha256 = g.sha256 AND a.place IS NOT NULL)
$$;

-- Removes some contents that no run names. A content that a cell gives at this moment stays. Answers with how many were looked at and removed.
CREATE FUNCTION remove_contents(most integer) RETURNS TABLE (looked bigint, removed bigint)
LANGUAGE plpgsql SET search_path = regrind, pg_temp AS $$
DECLARE
    chosen bytea[] := array(SELECT g.sha256 FROM archived_content g ORDER BY g.sha256 LIMIT most FOR UPDATE SKIP LOCKED);
    free bytea[] := array(SELECT a.sha256 FROM artefact a WHERE a.sha256 = ANY (chosen) ORDER BY a.sha256 FOR UPDATE SKIP LOCKED);
BEGIN
    looked := cardinality(chosen);
    DELETE FROM artefact_of o WHERE o.sha256 = ANY (free);
    DELETE FROM artefact a WHERE a.sha256 = ANY (free);
    DELETE FROM archived_content g WHERE g.sha256 = ANY (chosen);
    removed := cardinality(free);
    RETURN NEXT;
END $$;

-- A content that a run names is not removed, and one that is gone already is missing then, so that its cell gives it again.
CREATE FUNCTION keep_content() RETURNS trigger LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
BEGIN
    DELETE FROM archived_content WHERE sha256 = new.sha256;
    RETURN NULL;
END $$;
CREATE TRIGGER keep_content AFTER INSERT ON run_artefact FOR EACH ROW EXECUTE FUNCTION keep_content();

-- Makes the partitions of a block again, to which runs come back from the archive.
CREATE FUNCTION restore_partitions(of_run integer) RETURNS void
LANGUAGE plpgsql SET search_path = regrind, pg_temp SET lock_timeout = '500ms' AS $$
DECLARE
    b month_block%ROWTYPE;
BEGIN
    SELECT * INTO STRICT b FROM month_block m WHERE of_run >= m.first AND of_run < m.behind;
    IF NOT EXISTS (SELECT FROM pg_inherits i JOIN pg_class p ON p.oid = i.inhrelid WHERE i.inhparent = 'record'::regclass
            AND pg_get_expr(p.relpartbound, p.oid) = format('FOR VALUES FROM (%s) TO (%s)', b.first, b.behind)) THEN
        PERFORM make_partitions(b.first, b.behind);
    END IF;
END $$;
CREATE INDEX lesson_sha256 ON lesson (sha256);
-- The content first: an archived content is looked up here before it goes.
ALTER TABLE artefact_of DROP CONSTRAINT artefact_of_pkey;
ALTER TABLE artefact_of ADD PRIMARY KEY (sha256, cell);

ALTER TABLE month_block ENABLE ROW LEVEL SECURITY;
ALTER TABLE record ENABLE ROW LEVEL SECURITY;
ALTER TABLE run_artefact ENABLE ROW LEVEL SECURITY;
CREATE POLICY everything ON month_block FOR SELECT TO regrind_reader USING (true);
CREATE POLICY own ON record FOR SELECT TO regrind_cell
    USING (run IN (SELECT r.id FROM run r WHERE r.cell = (SELECT own_cell())));
CREATE POLICY own ON run_artefact FOR SELECT TO regrind_cell
    USING (run IN (SELECT r.id FROM run r WHERE r.cell = (SELECT own_cell())));
CREATE POLICY everything ON record FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON run_artefact FOR SELECT TO regrind_reader USING (true);
GRANT SELECT ON record, run_artefact TO regrind_cell, regrind_reader;
GRANT SELECT ON month_block, archivable TO regrind_reader;
ALTER TABLE archived_content ENABLE ROW LEVEL SECURITY;
