-- The records of all cells, as they were sealed at the cell, and what a glance asks of them.
--
-- A cell's role reads its own rows (row security) and writes through functions alone, which hold what it gives against what is there.
-- A function that refuses says so in its answer, so that the refusal itself can stand in `incident`.

CREATE TABLE cell (
    id integer GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    name text NOT NULL UNIQUE CHECK (length(name) BETWEEN 1 AND 80),
    -- By which it signs in.
    role name NOT NULL UNIQUE,
    enrolled_at timestamptz NOT NULL DEFAULT now(),
    retired_at timestamptz
);

-- The audit keys that may have signed the records of a cell, as quality gave them.
CREATE TABLE cell_key (
    cell integer NOT NULL REFERENCES cell,
    key text NOT NULL CHECK (key ~ '^[0-9a-f]{64}$'),
    since timestamptz NOT NULL DEFAULT now(),
    PRIMARY KEY (cell, key)
);

CREATE TABLE run (
    id integer GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    cell integer NOT NULL REFERENCES cell,
    name text NOT NULL CHECK (length(name) BETWEEN 1 AND 300),
    -- How far its chain has come, and the hash of the last record.
    records integer NOT NULL DEFAULT 0,
    head bytea NOT NULL DEFAULT decode(repeat('00', 32), 'hex'),
    arrived_at timestamptz NOT NULL DEFAULT now(),
    -- From its first record.
    part text NOT NULL DEFAULT '',
    simulation boolean,
    operator text,
    began timestamptz,
    -- From its last one.
    ended timestamptz,
    -- What the cell told of it at a glance; it is proven against the records on demand.
    recipe text,
    recipe_sha256 text,
    part_name text,
    result text,
    verdict text,
    pv_limit_um double precision,
    rms_limit_um double precision,
    grinder text,
    cmm text,
    wheel text,
    probe text,
    alarms integer,
    cycles integer,
    pv_um double precision,
    pv_u_um double precision,
    rms_um double precision,
    rms_u_um double precision,
    UNIQUE (cell, name)
);
CREATE INDEX run_began ON run (began DESC);
CREATE INDEX run_part ON run (part text_pattern_ops, began DESC);
CREATE INDEX run_recipe ON run (recipe, began DESC);
CREATE INDEX run_cell_began ON run (cell, began DESC);

CREATE TABLE record (
    run integer NOT NULL,
    seq integer NOT NULL,
    hash bytea NOT NULL,
    -- The text that was hashed, byte for byte: docs/journal.md.
    text text NOT NULL,
    PRIMARY KEY (run, seq)
);

CREATE TABLE cycle (
    run integer NOT NULL REFERENCES run,
    cycle integer NOT NULL,
    verdict text,
    reason text,
    pv_um double precision,
    pv_u_um double precision,
    rms_um double precision,
    rms_u_um double precision,
    expected_pv_um double precision,
    expected_rms_um double precision,
    -- Its error map among the files of the run.
    map text,
    PRIMARY KEY (run, cycle)
);

-- A file on record, by the name that it has in the run folder.
CREATE TABLE run_artefact (
    run integer NOT NULL,
    name text NOT NULL,
    sha256 bytea NOT NULL,
    bytes bigint NOT NULL,
    PRIMARY KEY (run, name, sha256)
);
CREATE INDEX run_artefact_sha256 ON run_artefact (sha256);

-- Each content once, here or at a place in the folder of the plant.
CREATE TABLE artefact (
    sha256 bytea PRIMARY KEY,
    bytes bigint NOT NULL,
    content bytea,
    place text,
    CHECK ((content IS NULL) <> (place IS NULL))
);
-- Who gave it: to know a hash is not to have the content.
CREATE TABLE artefact_of (
    cell integer NOT NULL REFERENCES cell,
    sha256 bytea NOT NULL REFERENCES artefact,
    PRIMARY KEY (cell, sha256)
);

-- How each cell was when it told last; a row a cell.
CREATE TABLE cell_state (
    cell integer PRIMARY KEY REFERENCES cell,
    at timestamptz NOT NULL,
    run text,
    snapshot jsonb NOT NULL
);

-- What should not have been: broken chains, cut journals, refusals.
CREATE TABLE incident (
    id bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    at timestamptz NOT NULL DEFAULT now(),
    role name NOT NULL DEFAULT session_user,
    cell integer REFERENCES cell,
    run text,
    what text NOT NULL,
    words text NOT NULL
);
CREATE INDEX incident_at ON incident (at DESC);

-- The cell of who has signed in; none for everybody else.
CREATE FUNCTION own_cell() RETURNS integer LANGUAGE sql STABLE SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
    SELECT id FROM cell WHERE role = session_user AND retired_at IS NULL
$$;

-- The cell of who has signed in, or an error for who is none.
CREATE FUNCTION must_be_a_cell() RETURNS integer LANGUAGE plpgsql STABLE SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := own_cell();
BEGIN
    IF mine IS NULL THEN
        RAISE EXCEPTION 'the role % is no cell of this plant, or one that was retired', session_user
            USING ERRCODE = 'insufficient_privilege', HINT = 'enrol it: regrind plant enrol';
    END IF;
    RETURN mine;
END $$;

-- Puts down what should not have been. Answers with its words.
CREATE FUNCTION complain(of_run text, of_what text, in_words text) RETURNS text
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
BEGIN
    INSERT INTO incident (cell, run, what, words) VALUES (own_cell(), left(of_run, 300), left(of_what, 80), left(in_words, 2000));
    RETURN in_words;
END $$;

-- Where a run of the cell stands; it is begun where it is not there.
CREATE FUNCTION open_run(of_name text) RETURNS TABLE (id integer, records integer, head bytea, is_ended boolean)
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
#variable_conflict use_column
DECLARE
    mine integer := must_be_a_cell();
BEGIN
    INSERT INTO run (cell, name) SELECT mine, of_name
        WHERE NOT EXISTS (SELECT FROM run r WHERE r.cell = mine AND r.name = of_name) ON CONFLICT (cell, name) DO NOTHING;
    RETURN QUERY SELECT r.id, r.records, r.head, r.ended IS NOT NULL FROM run r WHERE r.cell = mine AND r.name = of_name;
END $$;

-- Takes records of a run from a number on, each with the hash that it has at the cell. All of them stand afterwards, or none, and then
-- `refused` says why. Records that stand already are left as they are, if they are the same.
CREATE FUNCTION ship(of_run integer, from_seq integer, hashes bytea[], texts text[])
RETURNS TABLE (records integer, head bytea, refused text)
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
#variable_conflict use_column
DECLARE
    mine integer := must_be_a_cell();
    r run%ROWTYPE;
    flaw text;
    given integer := cardinality(texts);
BEGIN
    SELECT * INTO r FROM run WHERE run.id = of_run AND run.cell = mine FOR UPDATE;
    IF NOT FOUND THEN
        flaw := complain(NULL, 'a foreign run', format('records were given for run %s, which is none of this cell''s', of_run));
        RETURN QUERY SELECT 0, NULL::bytea, flaw;
        RETURN;
    END IF;
    IF from_seq <> r.records + 1 THEN
        -- Somebody else ships the same run, or the answer to an earlier call was lost: who asks goes on from where it stands.
        RETURN QUERY SELECT r.records, r.head, NULL::text;
        RETURN;
    END IF;
    BEGIN
        flaw := flaw_of(r, from_seq, hashes, texts);
    EXCEPTION WHEN data_exception THEN
        flaw := 'a record is no JSON, or a value of it is none';
    END;
    IF flaw IS NOT NULL THEN
        flaw := complain(r.name, 'a broken chain', flaw);
        RETURN QUERY SELECT r.records, r.head, flaw;
        RETURN;
    END IF;
    INSERT INTO record (run, seq, hash, text)
        SELECT of_run, from_seq + n::integer - 1, hash, text FROM unnest(hashes, texts) WITH ORDINALITY AS u (hash, text, n);
    PERFORM told_by(r, texts);
    UPDATE run SET records = r.records + given, head = hashes[given], arrived_at = now() WHERE run.id = of_run;
    RETURN QUERY SELECT r.records + given, hashes[given], NULL::text;
END $$;

-- What is wrong with records that are to stand behind those of a run; null where nothing is. The chain is that of docs/journal.md.
CREATE FUNCTION flaw_of(r run, from_seq integer, hashes bytea[], texts text[]) RETURNS text
LANGUAGE plpgsql SET search_path = regrind, pg_temp AS $$
DECLARE
    bad integer;
    its_part text := r.part;
BEGIN
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
        WHERE f.seq IS DISTINCT FROM from_seq + n - 1 OR f.part IS DISTINCT FROM its_part OR (f.kind = 'begin') <> (f.seq = 1)
            OR f.kind IS NULL OR (f.kind <> 'seal' AND r.ended IS NOT NULL);
    IF bad IS NOT NULL THEN
        RETURN format('record %s has another number or part than its place says, begins a second run, or stands behind the end', bad);
    END IF;
    RETURN NULL;
END $$;

-- Takes from new records what they tell of the run itself: its beginning, its end, its files.
CREATE FUNCTION told_by(r run, texts text[]) RETURNS void LANGUAGE plpgsql SET search_path = regrind, pg_temp AS $$
DECLARE
    line text;
    told json;
    content json;
BEGIN
    FOREACH line IN ARRAY texts LOOP
        IF line ~ '"kind":"(begin|end|artefact)","mono_ns":' THEN
            told := line::json;
            CASE told ->> 'kind'
            WHEN 'begin' THEN
                content := told -> 'payload' -> 'content';
                UPDATE run SET part = told ->> 'part', operator = told ->> 'actor', began = (told ->> 'utc')::timestamptz,
                    simulation = (told -> 'payload' ->> 'simulation')::boolean, part_name = content ->> 'part_name',
                    recipe_sha256 = content ->> 'recipe_sha256',
                    recipe = regexp_replace(content ->> 'recipe', '^.*[/\\]|\.toml$', '', 'g')
                    WHERE id = r.id;
            WHEN 'end' THEN
                UPDATE run SET ended = (told ->> 'utc')::timestamptz WHERE id = r.id;
            WHEN 'artefact' THEN
                INSERT INTO run_artefact (run, name, sha256, bytes)
                    SELECT r.id, f.name, decode(f.sha256, 'hex'), f.bytes
                    FROM json_to_record(told -> 'payload') AS f (name text, sha256 text, bytes bigint)
                    WHERE f.name IS NOT NULL AND f.sha256 ~ '^[0-9a-f]{64}$' AND f.bytes >= 0
                    ON CONFLICT DO NOTHING;
            ELSE NULL;
            END CASE;
        END IF;
    END LOOP;
END $$;

-- What a glance shows of a run, as the cell tells it from its own record.
CREATE FUNCTION tell_run(of_run integer, told jsonb) RETURNS void
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
    last jsonb;
BEGIN
    PERFORM FROM run WHERE id = of_run AND cell = mine FOR UPDATE;
    IF NOT FOUND THEN
        PERFORM complain(NULL, 'a foreign run', format('figures were told of run %s, which is none of this cell''s', of_run));
        RETURN;
    END IF;
    INSERT INTO cycle SELECT of_run, f.* FROM jsonb_to_recordset(told -> 'cycles') AS f (
            cycle integer, verdict text, reason text, pv_um double precision, pv_u_um double precision, rms_um double precision,
            rms_u_um double precision, expected_pv_um double precision, expected_rms_um double precision, map text)
        ON CONFLICT (run, cycle) DO UPDATE SET (verdict, reason, pv_um, pv_u_um, rms_um, rms_u_um, expected_pv_um, expected_rms_um, map)
            = (excluded.verdict, excluded.reason, excluded.pv_um, excluded.pv_u_um, excluded.rms_um, excluded.rms_u_um,
               excluded.expected_pv_um, excluded.expected_rms_um, excluded.map);
    -- The last cycle of which something is known.
    SELECT c INTO last FROM jsonb_array_elements(told -> 'cycles') AS c WHERE c -> 'pv_um' <> 'null' ORDER BY (c ->> 'cycle')::integer DESC LIMIT 1;
    UPDATE run SET result = told ->> 'result', verdict = told ->> 'verdict',
        pv_limit_um = (told ->> 'pv_limit_um')::double precision, rms_limit_um = (told ->> 'rms_limit_um')::double precision,
        grinder = told ->> 'grinder', cmm = told ->> 'cmm', wheel = told ->> 'wheel', probe = told ->> 'probe',
        alarms = (told ->> 'alarms')::integer, cycles = jsonb_array_length(told -> 'cycles'),
        pv_um = (last ->> 'pv_um')::double precision, pv_u_um = (last ->> 'pv_u_um')::double precision,
        rms_um = (last ->> 'rms_um')::double precision, rms_u_um = (last ->> 'rms_u_um')::double precision
        WHERE id = of_run;
END $$;

-- Takes the content of a file, by its hash. Answers whether it is what the hash says.
CREATE FUNCTION give_artefact(of_sha256 bytea, of_content bytea) RETURNS boolean
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
BEGIN
    IF sha256(of_content) IS DISTINCT FROM of_sha256 THEN
        PERFORM complain(NULL, 'a wrong file', format('a content was given for %s that has another hash', encode(of_sha256, 'hex')));
        RETURN false;
    END IF;
    INSERT INTO artefact (sha256, bytes, content) VALUES (of_sha256, length(of_content), of_content) ON CONFLICT DO NOTHING;
    INSERT INTO artefact_of (cell, sha256) VALUES (mine, of_sha256) ON CONFLICT DO NOTHING;
    RETURN true;
END $$;

-- Takes down that the content of a file lies in the folder of the plant, by the name that its hash gives it there. Answers whether it is read
-- there: what the database has from another cell is given here too, for to know a hash is not to have the content.
CREATE FUNCTION place_artefact(of_sha256 bytea, of_bytes bigint) RETURNS boolean
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
    digits text := encode(of_sha256, 'hex');
BEGIN
    IF length(of_sha256) <> 32 OR of_bytes < 0 THEN
        RETURN false;
    END IF;
    INSERT INTO artefact (sha256, bytes, place) VALUES (of_sha256, of_bytes, left(digits, 2) || '/' || digits) ON CONFLICT DO NOTHING;
    IF NOT EXISTS (SELECT FROM artefact WHERE sha256 = of_sha256 AND place IS NOT NULL) THEN
        RETURN false;
    END IF;
    INSERT INTO artefact_of (cell, sha256) VALUES (mine, of_sha256) ON CONFLICT DO NOTHING;
    RETURN true;
END $$;

-- The files on record of a run whose content the cell has not given yet.
CREATE FUNCTION missing_artefacts(of_run integer) RETURNS TABLE (name text, sha256 bytea, bytes bigint)
LANGUAGE sql STABLE SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
    SELECT a.name, a.sha256, a.bytes FROM run_artefact a JOIN run r ON r.id = a.run
        WHERE a.run = of_run AND r.cell = own_cell()
            AND NOT EXISTS (SELECT FROM artefact_of o WHERE o.cell = r.cell AND o.sha256 = a.sha256)
$$;

-- How the cell is now; a run of null where it has none.
CREATE FUNCTION tell_state(of_run text, of_snapshot jsonb) RETURNS void
LANGUAGE sql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
    INSERT INTO cell_state (cell, at, run, snapshot) VALUES (must_be_a_cell(), now(), of_run, of_snapshot)
        ON CONFLICT (cell) DO UPDATE SET (at, run, snapshot) = (excluded.at, excluded.run, excluded.snapshot)
$$;

ALTER TABLE cell ENABLE ROW LEVEL SECURITY;
ALTER TABLE cell_key ENABLE ROW LEVEL SECURITY;
ALTER TABLE run ENABLE ROW LEVEL SECURITY;
ALTER TABLE record ENABLE ROW LEVEL SECURITY;
ALTER TABLE cycle ENABLE ROW LEVEL SECURITY;
ALTER TABLE run_artefact ENABLE ROW LEVEL SECURITY;
ALTER TABLE artefact ENABLE ROW LEVEL SECURITY;
ALTER TABLE artefact_of ENABLE ROW LEVEL SECURITY;
ALTER TABLE cell_state ENABLE ROW LEVEL SECURITY;
ALTER TABLE incident ENABLE ROW LEVEL SECURITY;

CREATE POLICY own ON cell FOR SELECT TO regrind_cell USING (id = (SELECT own_cell()));
CREATE POLICY own ON cell_key FOR SELECT TO regrind_cell USING (cell = (SELECT own_cell()));
CREATE POLICY own ON run FOR SELECT TO regrind_cell USING (cell = (SELECT own_cell()));
CREATE POLICY own ON record FOR SELECT TO regrind_cell
    USING (run IN (SELECT r.id FROM run r WHERE r.cell = (SELECT own_cell())));
CREATE POLICY own ON cycle FOR SELECT TO regrind_cell
    USING (run IN (SELECT r.id FROM run r WHERE r.cell = (SELECT own_cell())));
CREATE POLICY own ON run_artefact FOR SELECT TO regrind_cell
    USING (run IN (SELECT r.id FROM run r WHERE r.cell = (SELECT own_cell())));
CREATE POLICY own ON artefact FOR SELECT TO regrind_cell
    USING (sha256 IN (SELECT o.sha256 FROM artefact_of o WHERE o.cell = (SELECT own_cell())));
CREATE POLICY own ON artefact_of FOR SELECT TO regrind_cell USING (cell = (SELECT own_cell()));
CREATE POLICY own ON cell_state FOR SELECT TO regrind_cell USING (cell = (SELECT own_cell()));
CREATE POLICY own ON incident FOR SELECT TO regrind_cell USING (cell = (SELECT own_cell()));

CREATE POLICY everything ON cell FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON cell_key FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON run FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON record FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON cycle FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON run_artefact FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON artefact FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON artefact_of FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON cell_state FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON incident FOR SELECT TO regrind_reader USING (true);

GRANT SELECT ON cell, cell_key, run, record, cycle, run_artefact, artefact, artefact_of, cell_state, incident
    TO regrind_cell, regrind_reader;
REVOKE EXECUTE ON ALL FUNCTIONS IN SCHEMA regrind FROM PUBLIC;
-- Policies ask who it is in the name of who reads.
GRANT EXECUTE ON FUNCTION own_cell() TO regrind_cell, regrind_reader;
GRANT EXECUTE ON FUNCTION complain(text, text, text), open_run(text), ship(integer, integer, bytea[], text[]), tell_run(integer, jsonb),
    give_artefact(bytea, bytea), place_artefact(bytea, bigint), missing_artefacts(integer), tell_state(text, jsonb) TO regrind_cell;
