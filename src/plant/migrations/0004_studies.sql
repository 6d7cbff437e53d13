-- Studies: simulated runs of a recipe, many of them, spread over workers. Each run is a job with a seed and what is changed in the recipe.

CREATE TABLE study (
    id integer GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    name text NOT NULL UNIQUE CHECK (length(name) BETWEEN 1 AND 80 AND name !~ '[[:cntrl:]]'),
    recipe text NOT NULL,
    text text NOT NULL,
    -- What the recipe names beside itself.
    names text[] NOT NULL,
    contents bytea[] NOT NULL,
    made_at timestamptz NOT NULL DEFAULT now(),
    made_by name NOT NULL DEFAULT session_user,
    stopped_at timestamptz
);

CREATE TABLE study_job (
    study integer NOT NULL REFERENCES study,
    job integer NOT NULL,
    -- Keys of the recipe and the values that they have here, as TOML has them.
    varied jsonb NOT NULL,
    seed bigint NOT NULL,
    state text NOT NULL DEFAULT 'open' CHECK (state IN ('open', 'leased', 'done', 'failed')),
    lease integer NOT NULL DEFAULT 0,
    leased_until timestamptz,
    worker name,
    done_at timestamptz,
    result jsonb,
    PRIMARY KEY (study, job)
);
CREATE INDEX study_job_open ON study_job (study, job) WHERE state IN ('open', 'leased');

-- Begins a study: every job is a set of values and a seed.
CREATE FUNCTION new_study(of_name text, of_recipe text, of_text text, of_names text[], of_contents bytea[], variations jsonb[], seeds bigint[])
RETURNS integer LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    made integer;
BEGIN
    INSERT INTO study (name, recipe, text, names, contents) VALUES (of_name, of_recipe, of_text, of_names, of_contents) RETURNING id INTO made;
    INSERT INTO study_job (study, job, varied, seed)
        SELECT made, row_number() OVER (ORDER BY s.n, v.n), v.varied, s.seed
        FROM unnest(seeds) WITH ORDINALITY AS s (seed, n) CROSS JOIN unnest(variations) WITH ORDINALITY AS v (varied, n);
    RETURN made;
END $$;

-- Leases the next job of the oldest study. One that three workers have lost is not given out again.
CREATE FUNCTION take_job(seconds integer) RETURNS TABLE (study integer, job integer, lease integer, varied jsonb, seed bigint)
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
#variable_conflict use_column
DECLARE
    found study_job%ROWTYPE;
BEGIN
    UPDATE study_job j SET state = 'failed', result = '{"error": "three workers took it, and none brought a result"}'
        WHERE j.state = 'leased' AND j.leased_until < now() AND j.lease >= 3;
    SELECT j.* INTO found FROM study_job j JOIN study s ON s.id = j.study AND s.stopped_at IS NULL
        WHERE j.state = 'open' OR (j.state = 'leased' AND j.leased_until < now())
        ORDER BY j.study, j.job LIMIT 1 FOR UPDATE OF j SKIP LOCKED;
    IF found.job IS NULL THEN
        RETURN;
    END IF;
    UPDATE study_job j SET state = 'leased', worker = session_user, lease = j.lease + 1,
        leased_until = now() + make_interval(secs => least(greatest(seconds, 1), 86400))
        WHERE j.study = found.study AND j.job = found.job;
    RETURN QUERY SELECT found.study, found.job, found.lease + 1, found.varied, found.seed;
END $$;

-- The recipe of a study, for who makes its runs.
CREATE FUNCTION study_recipe(of_study integer) RETURNS TABLE (recipe text, text text, names text[], contents bytea[])
LANGUAGE sql STABLE SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
    SELECT recipe, text, names, contents FROM study WHERE id = of_study
$$;

-- Takes the result of a job. Answers whether the lease still held: another worker has the job where it did not.
CREATE FUNCTION finish_job(of_study integer, of_job integer, of_lease integer, has_failed boolean, of_result jsonb) RETURNS boolean
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
BEGIN
    UPDATE study_job SET state = CASE WHEN has_failed THEN 'failed' ELSE 'done' END, result = of_result, done_at = now()
        WHERE study = of_study AND job = of_job AND lease = of_lease AND state = 'leased' AND worker = session_user;
    RETURN FOUND;
END $$;

-- Ends a study: what is under way is finished, and nothing more is given out.
CREATE FUNCTION stop_study(of_name text) RETURNS boolean
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
BEGIN
    UPDATE study SET stopped_at = now() WHERE name = of_name AND stopped_at IS NULL;
    RETURN FOUND;
END $$;

ALTER TABLE study ENABLE ROW LEVEL SECURITY;
ALTER TABLE study_job ENABLE ROW LEVEL SECURITY;
CREATE POLICY everything ON study FOR SELECT TO regrind_reader USING (true);
CREATE POLICY everything ON study_job FOR SELECT TO regrind_reader USING (true);
GRANT SELECT ON study, study_job TO regrind_reader;
REVOKE EXECUTE ON FUNCTION new_study(text, text, text, text[], bytea[], jsonb[], bigint[]), take_job(integer), study_recipe(integer),
    finish_job(integer, integer, integer, boolean, jsonb), stop_study(text) FROM PUBLIC;
GRANT EXECUTE ON FUNCTION new_study(text, text, text, text[], bytea[], jsonb[], bigint[]), stop_study(text) TO regrind_planner;
GRANT EXECUTE ON FUNCTION take_job(integer), study_recipe(integer), finish_job(integer, integer, integer, boolean, jsonb)
    TO regrind_worker;
