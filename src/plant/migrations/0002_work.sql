-- Work and what it is made by: recipes that two people have signed, and parts that cells take, each once.

-- The hash by which a recipe is known and signed: of its name, its version, its text and the files that it names, line by line.
CREATE FUNCTION recipe_sha256(of_name text, of_version integer, of_text text, of_files jsonb) RETURNS bytea
LANGUAGE sql IMMUTABLE SET search_path = regrind, pg_temp AS $$
    SELECT sha256(convert_to('regrind recipe 1' || chr(10) || of_name || chr(10) || of_version || chr(10)
        || encode(sha256(convert_to(of_text, 'UTF8')), 'hex') || chr(10)
        || (SELECT coalesce(string_agg(f.value || ' ' || f.key || chr(10), '' ORDER BY f.key COLLATE "C"), '') FROM jsonb_each_text(of_files) f),
        'UTF8'))
$$;

-- A recipe as it is: name, version, text and files belong together.
CREATE TABLE recipe (
    sha256 bytea PRIMARY KEY,
    name text NOT NULL CHECK (length(name) BETWEEN 1 AND 80 AND name !~ '[[:cntrl:]]'),
    version integer NOT NULL CHECK (version > 0),
    text text NOT NULL,
    -- Other files that it names, such as points of a nominal surface: the hash of each by its name.
    files jsonb NOT NULL DEFAULT '{}',
    proposed_at timestamptz NOT NULL DEFAULT now(),
    proposed_by name NOT NULL DEFAULT session_user,
    withdrawn_at timestamptz,
    withdrawn_by name,
    withdrawn_why text,
    UNIQUE (name, version),
    CHECK (sha256 = recipe_sha256(name, version, text, files))
);
CREATE TABLE recipe_file (
    recipe bytea NOT NULL REFERENCES recipe,
    name text NOT NULL CHECK (length(name) BETWEEN 1 AND 200 AND name !~ '[[:cntrl:]]'),
    content bytea NOT NULL,
    PRIMARY KEY (recipe, name)
);

-- Who has signed it: Ed25519 over the words that docs/plant.md gives, by a key that cells know. The cell proves it; here it is counted.
CREATE TABLE approval (
    recipe bytea NOT NULL REFERENCES recipe,
    person text NOT NULL CHECK (length(person) BETWEEN 1 AND 80 AND person !~ '[[:cntrl:]]'),
    key text NOT NULL CHECK (key ~ '^[0-9a-f]{64}$'),
    signature text NOT NULL CHECK (signature ~ '^[0-9a-f]{128}$'),
    at timestamptz NOT NULL DEFAULT now(),
    by name NOT NULL DEFAULT session_user,
    PRIMARY KEY (recipe, key),
    UNIQUE (recipe, person)
);

-- A part that is to be made.
CREATE TABLE work (
    id bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    serial text NOT NULL CHECK (length(serial) BETWEEN 1 AND 300),
    recipe bytea NOT NULL REFERENCES recipe,
    -- The cell that is to make it; any where it is null.
    for_cell integer REFERENCES cell,
    due date,
    queued_at timestamptz NOT NULL DEFAULT now(),
    queued_by name NOT NULL DEFAULT session_user,
    state text NOT NULL DEFAULT 'open' CHECK (state IN ('open', 'leased', 'begun', 'ended', 'withdrawn')),
    cell integer REFERENCES cell,
    -- Counts the leases: an old one opens nothing.
    lease integer NOT NULL DEFAULT 0,
    leased_until timestamptz,
    run text,
    begun_at timestamptz,
    CHECK ((state IN ('begun', 'ended')) = (run IS NOT NULL))
);
CREATE INDEX work_open ON work (due NULLS LAST, id) WHERE state IN ('open', 'leased');
CREATE UNIQUE INDEX work_run ON work (cell, run) WHERE run IS NOT NULL;
CREATE INDEX work_serial ON work (serial text_pattern_ops);

-- Every step of every part.
CREATE TABLE work_step (
    id bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    work bigint NOT NULL REFERENCES work,
    at timestamptz NOT NULL DEFAULT now(),
    role name NOT NULL DEFAULT session_user,
    step text NOT NULL,
    lease integer,
    words text NOT NULL DEFAULT ''
);
CREATE INDEX work_step_work ON work_step (work);

-- Whether two different people have signed a recipe that nobody has withdrawn. The cell proves the signatures itself.
CREATE FUNCTION is_approved(of_recipe bytea) RETURNS boolean LANGUAGE sql STABLE SET search_path = regrind, pg_temp AS $$
    SELECT EXISTS (SELECT FROM recipe WHERE sha256 = of_recipe AND withdrawn_at IS NULL)
        AND (SELECT count(*) >= 2 FROM approval WHERE recipe = of_recipe)
$$;

-- Leases the part that is due first to the cell. Nothing where there is none.
CREATE FUNCTION take_work(seconds integer)
RETURNS TABLE (id bigint, serial text, recipe bytea, due date, lease integer, until timestamptz)
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
#variable_conflict use_column
DECLARE
    mine integer := must_be_a_cell();
    found work%ROWTYPE;
BEGIN
    SELECT * INTO found FROM work w
        WHERE (w.state = 'open' OR (w.state = 'leased' AND w.leased_until < now()))
            AND (w.for_cell IS NULL OR w.for_cell = mine) AND is_approved(w.recipe)
        ORDER BY w.due NULLS LAST, w.id LIMIT 1 FOR UPDATE SKIP LOCKED;
    IF found.id IS NULL THEN
        RETURN;
    END IF;
    UPDATE work w SET state = 'leased', cell = mine, lease = w.lease + 1,
        leased_until = now() + make_interval(secs => least(greatest(seconds, 1), 86400)) WHERE w.id = found.id RETURNING * INTO found;
    INSERT INTO work_step (work, step, lease) VALUES (found.id, 'leased', found.lease);
    RETURN QUERY SELECT found.id, found.serial, found.recipe, found.due, found.lease, found.leased_until;
END $$;

-- Gives a lease more time, from now. Answers why not, where not.
CREATE FUNCTION renew_work(of_work bigint, of_lease integer, seconds integer) RETURNS text
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
BEGIN
    UPDATE work SET leased_until = now() + make_interval(secs => least(greatest(seconds, 1), 86400))
        WHERE id = of_work AND state = 'leased' AND cell = mine AND lease = of_lease;
    IF FOUND THEN
        RETURN NULL;
    END IF;
    RETURN refuse_work(of_work, of_lease, 'renew', 'its lease is over, or another cell has it');
END $$;

-- The run of a part begins: from here on the part is its run's, whatever becomes of the cell. The same call again has the same answer.
CREATE FUNCTION begin_work(of_work bigint, of_lease integer, of_run text) RETURNS text
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
    found work%ROWTYPE;
BEGIN
    SELECT * INTO found FROM work WHERE id = of_work FOR UPDATE;
    IF found.state = 'begun' AND found.cell = mine AND found.lease = of_lease AND found.run = of_run THEN
        RETURN NULL;
    END IF;
    IF found.state IS DISTINCT FROM 'leased' OR found.cell IS DISTINCT FROM mine OR found.lease IS DISTINCT FROM of_lease THEN
        RETURN refuse_work(of_work, of_lease, 'begin', CASE
            WHEN found.id IS NULL THEN 'there is no such part'
            WHEN found.state IN ('begun', 'ended') THEN 'it has been begun, by run ' || found.run
            WHEN found.state = 'withdrawn' THEN 'it was withdrawn'
            ELSE 'its lease is over, and another one holds' END);
    END IF;
    IF found.leased_until < now() THEN
        RETURN refuse_work(of_work, of_lease, 'begin', 'its lease ended at ' || found.leased_until);
    END IF;
    IF NOT is_approved(found.recipe) THEN
        RETURN refuse_work(of_work, of_lease, 'begin', 'its recipe is approved no longer');
    END IF;
    IF EXISTS (SELECT FROM run WHERE cell = mine AND name = of_run) OR EXISTS (SELECT FROM work WHERE cell = mine AND run = of_run) THEN
        RETURN refuse_work(of_work, of_lease, 'begin', 'there is a run of that name');
    END IF;
    UPDATE work SET state = 'begun', run = of_run, begun_at = now() WHERE id = of_work;
    INSERT INTO work_step (work, step, lease, words) VALUES (of_work, 'begun', of_lease, left(of_run, 300));
    RETURN NULL;
END $$;

-- Gives a leased part back, unbegun.
CREATE FUNCTION return_work(of_work bigint, of_lease integer, why text) RETURNS text
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
BEGIN
    UPDATE work SET state = 'open', cell = NULL, leased_until = NULL WHERE id = of_work AND state = 'leased' AND cell = mine AND lease = of_lease;
    IF NOT FOUND THEN
        RETURN refuse_work(of_work, of_lease, 'return', 'its lease is over, or another cell has it');
    END IF;
    INSERT INTO work_step (work, step, lease, words) VALUES (of_work, 'returned', of_lease, left(why, 300));
    RETURN NULL;
END $$;

-- Gives a part back whose run never came to anything, for the cell looked. One of whose run a command or an event has arrived is that run's.
CREATE FUNCTION give_back_work(of_work bigint, of_run text, why text) RETURNS text
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
BEGIN
    UPDATE work SET state = 'open', cell = NULL, leased_until = NULL, run = NULL, begun_at = NULL
        WHERE id = of_work AND state = 'begun' AND cell = mine AND run = of_run
            AND NOT EXISTS (SELECT FROM run r JOIN record e ON e.run = r.id
                WHERE r.cell = mine AND r.name = of_run AND e.text ~ '"kind":"(intent|event|end)","mono_ns":');
    IF NOT FOUND THEN
        RETURN refuse_work(of_work, NULL, 'give back', 'it was not begun by this cell in run ' || of_run || ', or something was asked of a machine there');
    END IF;
    INSERT INTO work_step (work, step, words) VALUES (of_work, 'given back', left(why, 300));
    RETURN NULL;
END $$;

-- Gives a part up whose run will not be gone on with. It stays that run's, and whether another is made in its place is for a planner to say.
CREATE FUNCTION give_up_work(of_work bigint, of_run text, why text) RETURNS text
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
BEGIN
    UPDATE work SET state = 'ended' WHERE id = of_work AND state = 'begun' AND cell = mine AND run = of_run;
    IF NOT FOUND THEN
        RETURN refuse_work(of_work, NULL, 'give up', 'it was not begun by this cell in run ' || of_run);
    END IF;
    INSERT INTO work_step (work, step, words) VALUES (of_work, 'given up', left(why, 300));
    RETURN NULL;
END $$;

CREATE FUNCTION refuse_work(of_work bigint, of_lease integer, step text, why text) RETURNS text
LANGUAGE sql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
    SELECT complain(NULL, 'work refused', format('%s of part %s with lease %s: %s', step, of_work, of_lease, why))
$$;

-- A recipe that is approved, whole, with who has signed it.
CREATE FUNCTION pull_recipe(of_sha256 bytea)
RETURNS TABLE (name text, version integer, text text, names text[], contents bytea[], persons text[], keys text[], signatures text[])
LANGUAGE plpgsql STABLE SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
#variable_conflict use_column
BEGIN
    PERFORM must_be_a_cell();
    RETURN QUERY SELECT r.name, r.version, r.text,
        array(SELECT f.name FROM recipe_file f WHERE f.recipe = r.sha256 ORDER BY f.name),
        array(SELECT f.content FROM recipe_file f WHERE f.recipe = r.sha256 ORDER BY f.name),
        array(SELECT a.person FROM approval a WHERE a.recipe = r.sha256 ORDER BY a.key),
        array(SELECT a.key FROM approval a WHERE a.recipe = r.sha256 ORDER BY a.key),
        array(SELECT a.signature FROM approval a WHERE a.recipe = r.sha256 ORDER BY a.key)
        FROM recipe r WHERE r.sha256 = of_sha256 AND r.withdrawn_at IS NULL;
END $$;

-- Brings the next version of a recipe. What is there under another name or version is refused, and that is put down.
CREATE FUNCTION propose_recipe(of_name text, of_version integer, of_text text, names text[], contents bytea[])
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
    SELECT * INTO known FROM recipe r WHERE r.text = of_text AND r.files = of_files;
    IF FOUND THEN
        RETURN QUERY SELECT known.sha256, complain(NULL, 'recipe refused', format('%s is version %s of %s%s', of_name, known.version, known.name,
            coalesce(', which was withdrawn: ' || known.withdrawn_why, '')));
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

-- Takes a recipe back: nobody begins a part by it any more.
CREATE FUNCTION withdraw_recipe(of_name text, of_version integer, why text) RETURNS boolean
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
BEGIN
    UPDATE recipe SET withdrawn_at = now(), withdrawn_by = session_user, withdrawn_why = left(why, 300)
        WHERE name = of_name AND version = of_version AND withdrawn_at IS NULL;
    RETURN FOUND;
END $$;

-- Puts a part into the queue.
CREATE FUNCTION queue_work(of_serial text, of_recipe bytea, cell_name text, of_due date) RETURNS bigint
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    made bigint;
    wanted integer := (SELECT c.id FROM cell c WHERE c.name = cell_name AND c.retired_at IS NULL);
BEGIN
    IF NOT is_approved(of_recipe) THEN
        RAISE EXCEPTION 'recipe % is not approved by two people, or was withdrawn', encode(of_recipe, 'hex')
            USING ERRCODE = 'check_violation', HINT = 'have it signed: regrind plant approve';
    END IF;
    IF cell_name IS NOT NULL AND wanted IS NULL THEN
        RAISE EXCEPTION 'there is no cell %', cell_name USING ERRCODE = 'check_violation', HINT = 'regrind plant cells lists them';
    END IF;
    IF EXISTS (SELECT FROM work WHERE serial = of_serial AND recipe = of_recipe AND state IN ('open', 'leased', 'begun')) THEN
        RAISE EXCEPTION 'part % is in the queue by this recipe, or being made', of_serial
            USING ERRCODE = 'check_violation', HINT = 'withdraw it first, or wait for its end';
    END IF;
    INSERT INTO work (serial, recipe, for_cell, due) VALUES (of_serial, of_recipe, wanted, of_due) RETURNING id INTO made;
    INSERT INTO work_step (work, step) VALUES (made, 'queued');
    RETURN made;
END $$;

-- Takes a part out of the queue that nobody has begun.
CREATE FUNCTION withdraw_work(of_work bigint, why text) RETURNS boolean
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
BEGIN
    UPDATE work SET state = 'withdrawn', leased_until = NULL WHERE id = of_work AND state IN ('open', 'leased');
    IF FOUND THEN
        INSERT INTO work_step (work, step, words) VALUES (of_work, 'withdrawn', left(why, 300));
    END IF;
    RETURN FOUND;
END $$;

-- When the end of a run comes in, so does that of its part.
CREATE FUNCTION work_ended() RETURNS trigger LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    ended bigint;
BEGIN
    UPDATE work SET state = 'ended' WHERE cell = new.cell AND run = new.name AND state = 'begun' RETURNING id INTO ended;
    IF ended IS NOT NULL THEN
        INSERT INTO work_step (work, step, words) VALUES (ended, 'ended', new.name);
    END IF;
    RETURN NULL;
END $$;
CREATE TRIGGER work_ended AFTER UPDATE OF ended ON run FOR EACH ROW WHEN (old.ended IS NULL AND new.ended IS NOT NULL) EXECUTE FUNCTION work_ended();

ALTER TABLE recipe ENABLE ROW LEVEL SECURITY;
ALTER TABLE recipe_file ENABLE ROW LEVEL SECURITY;
ALTER TABLE approval ENABLE ROW LEVEL SECURITY;
ALTER TABLE work ENABLE ROW LEVEL SECURITY;
ALTER TABLE work_step ENABLE ROW LEVEL SECURITY;
CREATE POLICY own ON work FOR SELECT TO regrind_cell USING (cell = (SELECT own_cell()));
CREATE POLICY everything ON recipe FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON recipe_file FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON approval FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON work FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON work_step FOR SELECT TO regrind_reader USING (true);
CREATE POLICY signs ON approval FOR INSERT TO regrind_planner WITH CHECK (true);

GRANT SELECT ON work TO regrind_cell;
GRANT SELECT ON recipe, recipe_file, approval, work, work_step TO regrind_reader;
GRANT INSERT (recipe, person, key, signature) ON approval TO regrind_planner;
REVOKE EXECUTE ON ALL FUNCTIONS IN SCHEMA regrind FROM PUBLIC;
GRANT EXECUTE ON FUNCTION take_work(integer), renew_work(bigint, integer, integer), begin_work(bigint, integer, text),
    return_work(bigint, integer, text), give_back_work(bigint, text, text), give_up_work(bigint, text, text), pull_recipe(bytea) TO regrind_cell;
GRANT EXECUTE ON FUNCTION queue_work(text, bytea, text, date), withdraw_work(bigint, text), withdraw_recipe(text, integer, text),
    propose_recipe(text, integer, text, text[], bytea[]) TO regrind_planner;
