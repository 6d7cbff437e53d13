-- Limits of what one cell can bring and break: sizes and quotas, files, lessons that their cell has signed, clocks, recipes that come back,
-- jobs of workers that died.

-- ---- quotas --------------------------------------------------------------------------------------------------------------

-- The owner changes the numbers (`regrind plant quota`). Days are those of UTC.
CREATE TABLE quota (
    name text PRIMARY KEY,
    most bigint NOT NULL CHECK (most > 0),
    meaning text NOT NULL
);
INSERT INTO quota VALUES
    ('state_bytes', 262144, 'bytes of the state that a cell reports'),
    ('record_bytes', 8388608, 'bytes of one record'),
    ('file_bytes', 268435456, 'bytes of one file in the database'),
    ('cycles_per_run', 1000, 'cycles that a cell reports of one run'),
    ('incidents_per_day', 200, 'incidents of one member in a day; further ones are counted'),
    ('runs_per_day', 5000, 'runs that one cell begins to send in a day'),
    ('bytes_per_day', 200000000000, 'bytes of records and files that one cell sends in a day');

CREATE FUNCTION quota_of(of_name text) RETURNS bigint LANGUAGE sql STABLE SET search_path = regrind, pg_temp AS $$
    SELECT most FROM quota WHERE name = of_name
$$;

-- Changes a quota. Answers whether there is one of that name.
CREATE FUNCTION set_quota(of_name text, to_most bigint) RETURNS boolean
LANGUAGE plpgsql SET search_path = regrind, pg_temp AS $$
BEGIN
    UPDATE quota SET most = to_most WHERE name = of_name;
    RETURN FOUND;
END $$;

-- What each cell has sent on a day, a row for each connection: no connection waits for another one, which could be a deadlock.
CREATE TABLE cell_usage (
    cell integer NOT NULL REFERENCES cell,
    day date NOT NULL,
    connection integer NOT NULL DEFAULT pg_backend_pid(),
    runs bigint NOT NULL DEFAULT 0,
    bytes bigint NOT NULL DEFAULT 0,
    PRIMARY KEY (cell, day, connection)
);

-- Counts what a cell sends. Raises an error that passes with the day where its quota is used up: the cell waits, and keeps its records.
CREATE FUNCTION count_usage(of_cell integer, of_runs bigint, of_bytes bigint) RETURNS void
LANGUAGE plpgsql SET search_path = regrind, pg_temp AS $$
DECLARE
    today constant date := (now() AT TIME ZONE 'UTC')::date;
    used_runs bigint;
    used_bytes bigint;
BEGIN
    UPDATE cell_usage SET runs = runs + of_runs, bytes = bytes + of_bytes WHERE cell = of_cell AND day = today AND connection = pg_backend_pid();
    IF NOT FOUND THEN
        INSERT INTO cell_usage (cell, day, runs, bytes) VALUES (of_cell, today, of_runs, of_bytes);
        DELETE FROM cell_usage u USING (SELECT o.ctid FROM cell_usage o WHERE o.cell = of_cell AND o.day < today - 31 FOR UPDATE SKIP LOCKED) old
            WHERE u.ctid = old.ctid;
    END IF;
    SELECT sum(runs), sum(bytes) INTO used_runs, used_bytes FROM cell_usage WHERE cell = of_cell AND day = today;
    IF of_runs > 0 AND used_runs > quota_of('runs_per_day') THEN
        RAISE EXCEPTION 'this cell has begun to send % runs today, the most of a day', quota_of('runs_per_day')
            USING ERRCODE = 'configuration_limit_exceeded', HINT = 'it goes on tomorrow; the owner of the plant can raise it: regrind plant quota';
    END IF;
    -- One that is larger than the quota of a whole day would never arrive.
    IF of_bytes > 0 AND used_bytes > quota_of('bytes_per_day') AND used_bytes > of_bytes THEN
        RAISE EXCEPTION 'this cell has sent % bytes today, the most of a day', quota_of('bytes_per_day')
            USING ERRCODE = 'configuration_limit_exceeded', HINT = 'it goes on tomorrow; the owner of the plant can raise it: regrind plant quota';
    END IF;
END $$;

-- ---- incidents -----------------------------------------------------------------------------------------------------------

-- The same incident again is counted.
ALTER TABLE incident ADD COLUMN times integer NOT NULL DEFAULT 1, ADD COLUMN last_at timestamptz;
CREATE INDEX incident_same ON incident (role, md5(coalesce(run, '') || chr(10) || what || chr(10) || words));
CREATE INDEX incident_role ON incident (role, at DESC);

-- Puts down what should not have been. Answers with its words. The same again is counted where it stands, and so is everything beyond the
-- quota of a day.
CREATE OR REPLACE FUNCTION complain(of_run text, of_what text, in_words text) RETURNS text
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    its_run constant text := left(of_run, 300);
    its_kind constant text := left(of_what, 80);
    its_words constant text := left(in_words, 2000);
    today constant timestamptz := date_trunc('day', now() AT TIME ZONE 'UTC') AT TIME ZONE 'UTC';
BEGIN
    -- A row that another connection holds is passed over, and stands twice then: to wait for it could be a deadlock, because who complains
    -- holds other rows.
    UPDATE incident SET times = times + 1, last_at = now() WHERE id = (SELECT id FROM incident WHERE role = session_user
        AND md5(coalesce(run, '') || chr(10) || what || chr(10) || words) = md5(coalesce(its_run, '') || chr(10) || its_kind || chr(10) || its_words)
        ORDER BY id DESC LIMIT 1 FOR UPDATE SKIP LOCKED);
    IF FOUND THEN
        RETURN in_words;
    END IF;
    IF (SELECT count(*) FROM incident WHERE role = session_user AND at >= today) < quota_of('incidents_per_day') THEN
        INSERT INTO incident (cell, run, what, words) VALUES (own_cell(), its_run, its_kind, its_words);
        RETURN in_words;
    END IF;
    UPDATE incident SET times = times + 1, last_at = now() WHERE id = (SELECT id FROM incident
        WHERE role = session_user AND at >= today AND what = 'too many incidents' LIMIT 1 FOR UPDATE SKIP LOCKED);
    IF NOT FOUND THEN
        INSERT INTO incident (cell, what, words)
            VALUES (own_cell(), 'too many incidents', 'more incidents than the quota of a day; further ones of this day are only counted');
    END IF;
    RETURN in_words;
END $$;

CREATE OR REPLACE VIEW incident_told WITH (security_invoker = true) AS
SELECT i.id, i.at, i.role::text AS by, c.name AS cell, i.run, i.what, i.words, i.times, coalesce(i.last_at, i.at) AS last_at
FROM incident i LEFT JOIN cell c ON c.id = i.cell;

-- ---- records and states --------------------------------------------------------------------------------------------------

CREATE OR REPLACE FUNCTION open_run(of_name text) RETURNS TABLE (id integer, records integer, head bytea, is_ended boolean)
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
#variable_conflict use_column
DECLARE
    mine integer := must_be_a_cell();
BEGIN
    INSERT INTO run (cell, name) SELECT mine, of_name
        WHERE NOT EXISTS (SELECT FROM run r WHERE r.cell = mine AND r.name = of_name) ON CONFLICT (cell, name) DO NOTHING;
    IF FOUND THEN
        PERFORM count_usage(mine, 1, 0);
    END IF;
    RETURN QUERY SELECT r.id, r.records, r.head, r.ended IS NOT NULL FROM run r WHERE r.cell = mine AND r.name = of_name;
END $$;

CREATE OR REPLACE FUNCTION ship(of_run integer, from_seq integer, hashes bytea[], texts text[])
RETURNS TABLE (records integer, head bytea, refused text)
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
#variable_conflict use_column
DECLARE
    mine integer := must_be_a_cell();
    r run%ROWTYPE;
    flaw text;
    given integer := cardinality(texts);
    sent bigint := (SELECT coalesce(sum(octet_length(t)), 0) FROM unnest(texts) t);
    longest bigint := (SELECT coalesce(max(octet_length(t)), 0) FROM unnest(texts) t);
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
    IF longest > quota_of('record_bytes') THEN
        flaw := complain(r.name, 'a record that is too long', format('a record behind %s has %s bytes, limit %s', r.records, longest, quota_of('record_bytes')));
        RETURN QUERY SELECT r.records, r.head, flaw;
        RETURN;
    END IF;
    BEGIN
        flaw := flaw_of(r, from_seq, hashes, texts);
        IF flaw IS NULL THEN
            INSERT INTO record (run, seq, hash, text)
                SELECT of_run, from_seq + n::integer - 1, hash, text FROM unnest(hashes, texts) WITH ORDINALITY AS u (hash, text, n);
            PERFORM told_by(r, texts);
        END IF;
    EXCEPTION WHEN data_exception THEN
        flaw := 'a record is no JSON, or a value of it is none';
    END;
    IF flaw IS NOT NULL THEN
        flaw := complain(r.name, 'a broken chain', flaw);
        RETURN QUERY SELECT r.records, r.head, flaw;
        RETURN;
    END IF;
    UPDATE run SET records = r.records + given, head = hashes[given], arrived_at = now() WHERE run.id = of_run;
    PERFORM count_usage(mine, 0, sent);
    RETURN QUERY SELECT r.records + given, hashes[given], NULL::text;
END $$;

-- The time of a record for lists and trends. A clock that is wrong must not put its run before all others for ever: a time before the year
-- 2000, or more than a day ahead, is replaced by the time of arrival, and that is put down. The record keeps what it says.
CREATE FUNCTION believed_time(of_run text, told text) RETURNS timestamptz
LANGUAGE plpgsql SET search_path = regrind, pg_temp AS $$
DECLARE
    said timestamptz;
BEGIN
    BEGIN
        said := told::timestamptz;
    EXCEPTION WHEN data_exception THEN
        said := NULL;
    END;
    -- PostgreSQL reads words such as `yesterday` as times.
    IF told ~ '^\d{4}-\d\d-\d\dT[0-9:.]+Z$' AND said BETWEEN '2000-01-01 00:00:00+00' AND now() + interval '1 day' THEN
        RETURN said;
    END IF;
    PERFORM complain(of_run, 'a wrong clock', format('a record says that its time is %s; lists show the time of its arrival', left(told, 40)));
    RETURN now();
END $$;

CREATE OR REPLACE FUNCTION told_by(r run, texts text[]) RETURNS void LANGUAGE plpgsql SET search_path = regrind, pg_temp AS $$
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
                UPDATE run SET part = left(told ->> 'part', 300), operator = left(told ->> 'actor', 300), began = believed_time(r.name, told ->> 'utc'),
                    simulation = (told -> 'payload' ->> 'simulation')::boolean, part_name = left(content ->> 'part_name', 300),
                    recipe_sha256 = left(content ->> 'recipe_sha256', 64),
                    recipe = left(regexp_replace(left(content ->> 'recipe', 4096), '^.*[/\\]|\.toml$', '', 'g'), 300)
                    WHERE id = r.id;
            WHEN 'end' THEN
                UPDATE run SET ended = believed_time(r.name, told ->> 'utc') WHERE id = r.id;
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

-- What a cell told before is cut too. What it told of times before is read again.
UPDATE run SET part = left(part, 300), operator = left(operator, 300), part_name = left(part_name, 300), recipe = left(recipe, 300)
    WHERE greatest(length(part), length(operator), length(part_name), length(recipe)) > 300;
UPDATE run SET began = least(began, arrived_at) WHERE began > arrived_at + interval '1 day';
UPDATE run SET ended = least(ended, arrived_at) WHERE ended > arrived_at + interval '1 day';

CREATE OR REPLACE FUNCTION tell_run(of_run integer, told jsonb) RETURNS void
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
    of_name text;
    last jsonb;
BEGIN
    SELECT name INTO of_name FROM run WHERE id = of_run AND cell = mine FOR UPDATE;
    IF NOT FOUND THEN
        PERFORM complain(NULL, 'a foreign run', format('figures were told of run %s, which is none of this cell''s', of_run));
        RETURN;
    END IF;
    IF octet_length(told::text) > quota_of('record_bytes') OR jsonb_typeof(told -> 'cycles') IS DISTINCT FROM 'array'
        OR jsonb_array_length(told -> 'cycles') > quota_of('cycles_per_run') THEN
        PERFORM complain(of_name, 'a report refused', format('its figures have %s bytes, or more cycles than %s', octet_length(told::text), quota_of('cycles_per_run')));
        RETURN;
    END IF;
    -- A report has all cycles of its run.
    DELETE FROM cycle y WHERE y.run = of_run AND NOT EXISTS (SELECT FROM jsonb_array_elements(told -> 'cycles') c WHERE c -> 'cycle' = to_jsonb(y.cycle));
    INSERT INTO cycle SELECT of_run, f.cycle, left(f.verdict, 300), left(f.reason, 1000), f.pv_um, f.pv_u_um, f.rms_um, f.rms_u_um, f.expected_pv_um,
            f.expected_rms_um, left(f.map, 300)
        FROM jsonb_to_recordset(told -> 'cycles') AS f (
            cycle integer, verdict text, reason text, pv_um double precision, pv_u_um double precision, rms_um double precision,
            rms_u_um double precision, expected_pv_um double precision, expected_rms_um double precision, map text)
        ON CONFLICT (run, cycle) DO UPDATE SET (verdict, reason, pv_um, pv_u_um, rms_um, rms_u_um, expected_pv_um, expected_rms_um, map)
            = (excluded.verdict, excluded.reason, excluded.pv_um, excluded.pv_u_um, excluded.rms_um, excluded.rms_u_um,
               excluded.expected_pv_um, excluded.expected_rms_um, excluded.map);
    -- The last cycle of which something is known.
    SELECT c INTO last FROM jsonb_array_elements(told -> 'cycles') AS c WHERE c -> 'pv_um' <> 'null' ORDER BY (c ->> 'cycle')::integer DESC LIMIT 1;
    UPDATE run SET result = left(told ->> 'result', 80), verdict = left(told ->> 'verdict', 300),
        pv_limit_um = (told ->> 'pv_limit_um')::double precision, rms_limit_um = (told ->> 'rms_limit_um')::double precision,
        grinder = left(told ->> 'grinder', 300), cmm = left(told ->> 'cmm', 300), wheel = left(told ->> 'wheel', 300), probe = left(told ->> 'probe', 300),
        alarms = (told ->> 'alarms')::integer, cycles = jsonb_array_length(told -> 'cycles'),
        pv_um = (last ->> 'pv_um')::double precision, pv_u_um = (last ->> 'pv_u_um')::double precision,
        rms_um = (last ->> 'rms_um')::double precision, rms_u_um = (last ->> 'rms_u_um')::double precision
        WHERE id = of_run;
END $$;

-- A state that is too large is put down, and the last one stays.
CREATE OR REPLACE FUNCTION tell_state(of_run text, of_snapshot jsonb) RETURNS void
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
    found_bytes bigint := octet_length(of_snapshot::text);
BEGIN
    IF found_bytes > quota_of('state_bytes') THEN
        PERFORM complain(of_run, 'a state refused', format('the state of the cell is larger than the limit of %s bytes', quota_of('state_bytes')));
        RETURN;
    END IF;
    INSERT INTO cell_state (cell, at, run, snapshot) VALUES (mine, now(), left(of_run, 300), of_snapshot)
        ON CONFLICT (cell) DO UPDATE SET (at, run, snapshot) = (excluded.at, excluded.run, excluded.snapshot);
END $$;
-- One that is larger already is none.
DELETE FROM cell_state WHERE octet_length(snapshot::text) > quota_of('state_bytes');

-- ---- files ---------------------------------------------------------------------------------------------------------------

-- A content can be here and in the folder. A cell that says where a file lies must not keep the content of another cell out.
ALTER TABLE artefact DROP CONSTRAINT artefact_check;
ALTER TABLE artefact ADD CHECK (content IS NOT NULL OR place IS NOT NULL);

CREATE OR REPLACE FUNCTION give_artefact(of_sha256 bytea, of_content bytea) RETURNS boolean
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
BEGIN
    IF length(of_content) > quota_of('file_bytes') THEN
        PERFORM complain(NULL, 'a file that is too large', format('a content of %s bytes was given, limit %s', length(of_content), quota_of('file_bytes')));
        RETURN false;
    END IF;
    IF sha256(of_content) IS DISTINCT FROM of_sha256 THEN
        PERFORM complain(NULL, 'a wrong file', format('a content was given for %s that has another hash', encode(of_sha256, 'hex')));
        RETURN false;
    END IF;
    INSERT INTO artefact (sha256, bytes, content) VALUES (of_sha256, length(of_content), of_content)
        ON CONFLICT (sha256) DO UPDATE SET content = excluded.content, bytes = excluded.bytes WHERE artefact.content IS NULL;
    IF FOUND THEN
        PERFORM count_usage(mine, 0, length(of_content));
    END IF;
    INSERT INTO artefact_of (cell, sha256) VALUES (mine, of_sha256) ON CONFLICT DO NOTHING;
    RETURN true;
END $$;

-- ---- lessons -------------------------------------------------------------------------------------------------------------

-- What proves a lesson: the records from the one that names its file to the last seal, and the hash of the record before them. Who reads a
-- lesson verifies the chain and the signature; the key is one of its cell's.
ALTER TABLE lesson ADD COLUMN before bytea, ADD COLUMN texts text[];

-- The records that prove a lesson. None where the run did not end with a seal by a key of its cell, or where there are too many.
CREATE FUNCTION proof_of_lesson(r run, of_sha256 bytea) RETURNS TABLE (before bytea, texts text[])
LANGUAGE plpgsql STABLE SET search_path = regrind, pg_temp AS $$
#variable_conflict use_column
DECLARE
    first integer;
    seal json;
BEGIN
    SELECT max(e.seq) INTO first FROM record e WHERE e.run = r.id AND e.text ~ '"kind":"artefact","mono_ns":'
        AND e.text LIKE '%"sha256":"' || encode(of_sha256, 'hex') || '"%' AND e.text::json -> 'payload' ->> 'name' = 'learned.json';
    SELECT e.text::json INTO seal FROM record e WHERE e.run = r.id AND e.seq = r.records;
    IF first IS NULL OR first < 2 OR r.records - first > 60
        OR (SELECT sum(octet_length(e.text)) FROM record e WHERE e.run = r.id AND e.seq >= first) > 1048576 OR seal ->> 'kind' IS DISTINCT FROM 'seal'
        OR NOT EXISTS (SELECT FROM cell_key k WHERE k.cell = r.cell AND k.key = seal -> 'payload' ->> 'key') THEN
        RETURN;
    END IF;
    RETURN QUERY SELECT (SELECT e.hash FROM record e WHERE e.run = r.id AND e.seq = first - 1),
        (SELECT array_agg(e.text ORDER BY e.seq) FROM record e WHERE e.run = r.id AND e.seq >= first);
END $$;

UPDATE lesson l SET (before, texts) = (SELECT p.before, p.texts FROM run r CROSS JOIN LATERAL proof_of_lesson(r, l.sha256) p WHERE r.id = l.run);
DELETE FROM lesson WHERE texts IS NULL;
ALTER TABLE lesson ALTER COLUMN before SET NOT NULL, ALTER COLUMN texts SET NOT NULL;

CREATE OR REPLACE FUNCTION teach(of_run integer, of_kind text, of_sha256 bytea) RETURNS text
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
    r run%ROWTYPE;
    proof record;
BEGIN
    SELECT * INTO r FROM run WHERE id = of_run AND cell = mine;
    IF NOT FOUND THEN
        RETURN complain(NULL, 'a lesson refused', format('something was taught by run %s, which is none of this cell''s', of_run));
    END IF;
    IF r.ended IS NULL OR r.simulation IS NULL THEN
        RETURN complain(r.name, 'a lesson refused', format('%s is not over, and teaches nothing yet', r.name));
    END IF;
    IF NOT EXISTS (SELECT FROM run_artefact a WHERE a.run = of_run AND a.name = 'learned.json' AND a.sha256 = of_sha256)
        OR NOT EXISTS (SELECT FROM artefact_of o WHERE o.cell = mine AND o.sha256 = of_sha256) THEN
        RETURN complain(r.name, 'a lesson refused', format('what %s is said to have taught is not on its record', r.name));
    END IF;
    IF of_kind IS NULL OR length(of_kind) NOT BETWEEN 1 AND 8000 THEN
        RETURN complain(r.name, 'a lesson refused', format('%s does not say for which parts its lesson is', r.name));
    END IF;
    SELECT * INTO proof FROM proof_of_lesson(r, of_sha256);
    IF NOT FOUND THEN
        -- A cell without a key is no incident.
        RETURN 'it teaches no other cell, because its end is not signed with a key that is enrolled for this cell';
    END IF;
    INSERT INTO lesson (run, cell, kind, simulation, sha256, before, texts)
        VALUES (of_run, mine, of_kind, r.simulation, of_sha256, proof.before, proof.texts) ON CONFLICT DO NOTHING;
    RETURN NULL;
END $$;

-- A cell that was retired teaches nothing more.
CREATE OR REPLACE VIEW newest_lesson AS
    SELECT DISTINCT ON (l.cell, md5(l.kind), l.simulation)
        l.kind, l.simulation, l.cell, c.name AS cell_name, r.name AS run, r.ended, l.sha256, a.content, a.place, l.before, l.texts,
        array(SELECT k.key FROM cell_key k WHERE k.cell = l.cell ORDER BY k.key) AS keys
    FROM lesson l JOIN run r ON r.id = l.run JOIN cell c ON c.id = l.cell JOIN artefact a ON a.sha256 = l.sha256
    WHERE a.bytes <= 4194304 AND c.retired_at IS NULL
    ORDER BY l.cell, md5(l.kind), l.simulation, r.ended DESC;

DROP FUNCTION lessons(text, boolean), lessons_in_common(boolean);

CREATE FUNCTION lessons(of_kind text, of_simulation boolean)
RETURNS TABLE (cell text, run text, sha256 bytea, content bytea, place text, before bytea, texts text[], keys text[])
LANGUAGE plpgsql STABLE SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
BEGIN
    RETURN QUERY SELECT n.cell_name, n.run, n.sha256, n.content, n.place, n.before, n.texts, n.keys FROM newest_lesson n
        WHERE md5(n.kind) = md5(of_kind) AND n.kind = of_kind AND n.simulation = of_simulation AND n.cell <> mine
        ORDER BY n.ended DESC LIMIT 8;
END $$;

CREATE FUNCTION lessons_in_common(of_simulation boolean)
RETURNS TABLE (kind text, is_own boolean, cell text, run text, sha256 bytea, content bytea, place text, before bytea, texts text[], keys text[])
LANGUAGE plpgsql STABLE SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
BEGIN
    RETURN QUERY
        WITH known AS (
            SELECT l.kind, bool_or(l.cell = mine) AS is_ours, max(l.run) AS newest FROM lesson l WHERE l.simulation = of_simulation
            GROUP BY l.kind HAVING count(DISTINCT l.cell) > 1
            ORDER BY 2 DESC, 3 DESC LIMIT 8
        ), ranked AS (
            SELECT n.*, k.is_ours, k.newest, row_number() OVER (PARTITION BY n.kind ORDER BY n.cell = mine DESC, n.ended DESC) AS place_of
            FROM newest_lesson n JOIN known k ON k.kind = n.kind WHERE n.simulation = of_simulation
        )
        SELECT k.kind, k.cell = mine, k.cell_name, k.run, k.sha256, k.content, k.place, k.before, k.texts, k.keys FROM ranked k
        WHERE k.place_of <= 4 ORDER BY k.is_ours DESC, k.newest DESC, k.kind, k.place_of;
END $$;

-- ---- recipes -------------------------------------------------------------------------------------------------------------

-- A name that was typed wrongly must not use up a version: a key can sign again, and the name of a person blocks no other key. A cell
-- counts the signatures of the people in its own plant file.
ALTER TABLE approval DROP CONSTRAINT approval_recipe_person_key;
-- Signatures that were replaced.
CREATE TABLE approval_replaced (
    id bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    recipe bytea NOT NULL REFERENCES recipe,
    person text NOT NULL,
    key text NOT NULL,
    signature text NOT NULL,
    at timestamptz NOT NULL,
    by name NOT NULL,
    replaced_at timestamptz NOT NULL DEFAULT now(),
    replaced_by name NOT NULL DEFAULT session_user
);
DROP POLICY signs ON approval;
REVOKE INSERT (recipe, person, key, signature) ON approval FROM regrind_planner;

CREATE OR REPLACE FUNCTION is_approved(of_recipe bytea) RETURNS boolean LANGUAGE sql STABLE SET search_path = regrind, pg_temp AS $$
    SELECT EXISTS (SELECT FROM recipe WHERE sha256 = of_recipe AND withdrawn_at IS NULL)
        AND (SELECT least(count(DISTINCT person), count(DISTINCT key)) >= 2 FROM approval WHERE recipe = of_recipe)
$$;

-- Stores a signature. A key that has signed under another name, and a person for whom another key has signed, are refused with that name
-- and key unless the signature is to replace the one of this key.
CREATE FUNCTION sign_recipe(of_recipe bytea, by_person text, by_key text, its_signature text, is_replacing boolean)
RETURNS TABLE (person text, key text) LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
#variable_conflict use_column
DECLARE
    in_the_way approval%ROWTYPE;
BEGIN
    SELECT * INTO in_the_way FROM approval a WHERE a.recipe = of_recipe AND (a.key = by_key OR a.person = by_person)
        ORDER BY a.key = by_key DESC LIMIT 1 FOR UPDATE;
    IF FOUND AND (NOT is_replacing OR (in_the_way.key = by_key AND in_the_way.signature = its_signature)) THEN
        RETURN QUERY SELECT in_the_way.person, in_the_way.key;
        RETURN;
    END IF;
    IF EXISTS (SELECT FROM recipe r WHERE r.sha256 = of_recipe AND r.withdrawn_at IS NOT NULL) THEN
        RAISE EXCEPTION 'this version was withdrawn' USING ERRCODE = 'check_violation', HINT = 'propose the recipe again: regrind plant propose';
    END IF;
    IF in_the_way.key = by_key THEN
        INSERT INTO approval_replaced (recipe, person, key, signature, at, by) SELECT a.recipe, a.person, a.key, a.signature, a.at, a.by
            FROM approval a WHERE a.recipe = of_recipe AND a.key = by_key;
        PERFORM complain(NULL, 'a signature replaced', format('the signature of %s on recipe %s is replaced by one of %s with the same key',
            in_the_way.person, left(encode(of_recipe, 'hex'), 12), by_person));
    END IF;
    INSERT INTO approval AS a (recipe, person, key, signature) VALUES (of_recipe, by_person, by_key, its_signature)
        ON CONFLICT (recipe, key) DO UPDATE SET (person, signature, at, by) = (excluded.person, excluded.signature, now(), session_user);
END $$;

-- The text of a recipe that was withdrawn comes back under its name, as the next version, which two people sign anew.
CREATE OR REPLACE FUNCTION propose_recipe(of_name text, of_version integer, of_text text, names text[], contents bytea[])
RETURNS TABLE (sha256 bytea, refused text) LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
#variable_conflict use_column
DECLARE
    of_files jsonb;
    known recipe%ROWTYPE;
    newest integer;
    made bytea;
BEGIN
    -- One at a time, so that a version is given once.
    LOCK TABLE recipe IN SHARE ROW EXCLUSIVE MODE;
    SELECT coalesce(jsonb_object_agg(n, encode(pg_catalog.sha256(c), 'hex')), '{}') INTO of_files FROM unnest(names, contents) AS u (n, c);
    SELECT * INTO known FROM recipe r WHERE r.text = of_text AND r.files = of_files AND (r.withdrawn_at IS NULL OR r.name <> of_name)
        ORDER BY r.withdrawn_at DESC NULLS FIRST, r.version DESC LIMIT 1;
    IF FOUND THEN
        RETURN QUERY SELECT known.sha256, complain(NULL, 'recipe refused', format('%s is version %s of %s%s', of_name, known.version, known.name,
            coalesce(', which was withdrawn: ' || known.withdrawn_why || '; it can come back under the name ' || known.name, '')));
        RETURN;
    END IF;
    newest := (SELECT coalesce(max(r.version), 0) FROM recipe r WHERE r.name = of_name);
    IF of_version <> newest + 1 THEN
        RETURN QUERY SELECT NULL::bytea, format('the newest version of %s is %s', of_name, newest);
        RETURN;
    END IF;
    made := recipe_sha256(of_name, of_version, of_text, of_files);
    INSERT INTO recipe (sha256, name, version, text, files) VALUES (made, of_name, of_version, of_text, of_files);
    INSERT INTO recipe_file (recipe, name, content) SELECT made, n, c FROM unnest(names, contents) AS u (n, c);
    RETURN QUERY SELECT made, NULL::text;
END $$;

DROP FUNCTION withdraw_recipe(text, integer, text);

-- Takes a recipe back: nobody begins a part by it any more. The parts that wait for it would wait for ever, so they leave the queue. Answers
-- with them, and with nothing where there is no such recipe.
CREATE FUNCTION withdraw_recipe(of_name text, of_version integer, why text) RETURNS text[]
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    taken bytea;
BEGIN
    UPDATE recipe SET withdrawn_at = now(), withdrawn_by = session_user, withdrawn_why = left(why, 300)
        WHERE name = of_name AND version = of_version AND withdrawn_at IS NULL RETURNING sha256 INTO taken;
    IF taken IS NULL THEN
        RETURN NULL;
    END IF;
    RETURN leave_queue(taken);
END $$;

-- Takes the parts of a recipe that was withdrawn out of the queue. Answers with their serial numbers.
CREATE FUNCTION leave_queue(of_recipe bytea) RETURNS text[] LANGUAGE sql SET search_path = regrind, pg_temp AS $$
    WITH gone AS (
        UPDATE work SET state = 'withdrawn', leased_until = NULL WHERE recipe = of_recipe AND state IN ('open', 'leased') RETURNING id, serial
    ), told AS (
        INSERT INTO work_step (work, step, words) SELECT id, 'withdrawn', 'its recipe was withdrawn' FROM gone
    )
    SELECT coalesce(array_agg(serial ORDER BY id), '{}') FROM gone
$$;
SELECT leave_queue(sha256) FROM recipe WHERE withdrawn_at IS NOT NULL;

-- A part that comes back to the queue, or comes into it while its recipe is withdrawn, would wait for ever.
CREATE FUNCTION leave_withdrawn() RETURNS trigger LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    withdrawn timestamptz;
BEGIN
    SELECT withdrawn_at INTO withdrawn FROM recipe WHERE sha256 = new.recipe FOR SHARE;
    IF withdrawn IS NOT NULL THEN
        new.state := 'withdrawn';
        IF TG_OP = 'UPDATE' THEN
            INSERT INTO work_step (work, step, words) VALUES (new.id, 'withdrawn', 'its recipe was withdrawn');
        END IF;
    END IF;
    RETURN new;
END $$;
CREATE TRIGGER leave_withdrawn BEFORE INSERT OR UPDATE OF state ON work FOR EACH ROW WHEN (new.state = 'open') EXECUTE FUNCTION leave_withdrawn();

-- ---- studies -------------------------------------------------------------------------------------------------------------

-- Takes the result of a job. Answers whether the lease still held: another worker has the job where it did not.
CREATE OR REPLACE FUNCTION finish_job(of_study integer, of_job integer, of_lease integer, has_failed boolean, of_result jsonb) RETURNS boolean
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    is_long constant boolean := octet_length(of_result::text) > quota_of('state_bytes');
BEGIN
    UPDATE study_job SET state = CASE WHEN has_failed OR is_long THEN 'failed' ELSE 'done' END, done_at = now(),
        result = CASE WHEN is_long THEN '{"error": "the result is too long"}' ELSE of_result END
        WHERE study = of_study AND job = of_job AND lease = of_lease AND state = 'leased' AND worker = session_user;
    RETURN FOUND;
END $$;

-- Gives a job more time, from now. Answers whether the lease still held.
CREATE FUNCTION renew_job(of_study integer, of_job integer, of_lease integer, seconds integer) RETURNS boolean
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
BEGIN
    UPDATE study_job SET leased_until = now() + make_interval(secs => least(greatest(seconds, 1), 86400))
        WHERE study = of_study AND job = of_job AND lease = of_lease AND state = 'leased' AND worker = session_user;
    RETURN FOUND;
END $$;

-- ---- connections ---------------------------------------------------------------------------------------------------------

-- A cell has a few programs. No cell takes the connections of the others.
DO $$
DECLARE
    of_cell name;
BEGIN
    FOR of_cell IN SELECT role FROM regrind.cell LOOP
        EXECUTE format('ALTER ROLE %I CONNECTION LIMIT 12', of_cell);
    END LOOP;
EXCEPTION WHEN insufficient_privilege OR undefined_object THEN
    -- The roles of a restored database can be missing, or another role made them.
    NULL;
END $$;

-- ---- rights --------------------------------------------------------------------------------------------------------------

ALTER TABLE quota ENABLE ROW LEVEL SECURITY;
ALTER TABLE cell_usage ENABLE ROW LEVEL SECURITY;
CREATE POLICY everything ON quota FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON cell_usage FOR SELECT TO regrind_reader USING (true);
ALTER TABLE approval_replaced ENABLE ROW LEVEL SECURITY;
CREATE POLICY everything ON approval_replaced FOR SELECT TO regrind_reader USING (true);
GRANT SELECT ON quota, cell_usage, approval_replaced TO regrind_reader;
REVOKE ALL ON newest_lesson FROM PUBLIC;
REVOKE EXECUTE ON FUNCTION quota_of(text), set_quota(text, bigint), count_usage(integer, bigint, bigint), believed_time(text, text), proof_of_lesson(run, bytea),
    lessons(text, boolean), lessons_in_common(boolean), sign_recipe(bytea, text, text, text, boolean), withdraw_recipe(text, integer, text), leave_queue(bytea),
    renew_job(integer, integer, integer, integer) FROM PUBLIC;
GRANT EXECUTE ON FUNCTION lessons(text, boolean), lessons_in_common(boolean) TO regrind_cell;
GRANT EXECUTE ON FUNCTION sign_recipe(bytea, text, text, text, boolean), withdraw_recipe(text, integer, text) TO regrind_planner;
GRANT EXECUTE ON FUNCTION renew_job(integer, integer, integer, integer) TO regrind_worker;
