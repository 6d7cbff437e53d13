-- Counts of parts by day, kept while runs end, so that no page counts all runs; and indexes that are smaller than the table of runs.

-- Whether a given-up part was simulated where its run does not say: as the newest run of its cell when it was given up. So what was counted
-- stays, whatever the cell makes later.
ALTER TABLE work_step ADD COLUMN simulation boolean;

-- Whether the newest run of a cell is simulated; real where no run says it.
CREATE FUNCTION newest_is_simulated(of_cell integer) RETURNS boolean
LANGUAGE sql STABLE SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
    SELECT coalesce((SELECT newest.simulation FROM (VALUES (true), (false)) world (simulation) CROSS JOIN LATERAL (
            SELECT r.simulation, r.began FROM run r WHERE r.cell = of_cell AND r.simulation = world.simulation AND r.began IS NOT NULL
            ORDER BY (r.began AT TIME ZONE 'UTC')::date DESC, r.began DESC LIMIT 1) newest
        ORDER BY newest.began DESC LIMIT 1), false)
$$;
REVOKE EXECUTE ON FUNCTION newest_is_simulated(integer) FROM PUBLIC;

UPDATE work_step s SET simulation = newest_is_simulated(w.cell) FROM work w WHERE w.id = s.work AND s.step = 'given up';

CREATE FUNCTION mark_given_up() RETURNS trigger LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
BEGIN
    IF TG_RELID <> 'regrind.work_step'::regclass THEN
        RAISE EXCEPTION 'this function is for the table work_step alone' USING ERRCODE = 'insufficient_privilege';
    END IF;
    new.simulation := newest_is_simulated((SELECT w.cell FROM work w WHERE w.id = new.work));
    RETURN new;
END $$;
CREATE TRIGGER mark_given_up BEFORE INSERT ON work_step FOR EACH ROW WHEN (new.step = 'given up' AND new.simulation IS NULL)
    EXECUTE FUNCTION mark_given_up();

-- Every part that was given up and whose run has not ended. Whether it was simulated, its run says, or the newest run of its cell at that time.
CREATE OR REPLACE VIEW part_given_up WITH (security_invoker = true) AS
SELECT w.id AS work, c.name AS cell, w.run, w.serial, coalesce(r.recipe, p.name) AS recipe,
    coalesce(r.simulation, s.simulation, false) AS simulation, r.began, s.at AS given_up, s.words AS reason
FROM work_step s JOIN work w ON w.id = s.work JOIN cell c ON c.id = w.cell JOIN recipe p ON p.sha256 = w.recipe
    LEFT JOIN run r ON r.cell = w.cell AND r.name = w.run
WHERE s.step = 'given up' AND r.ended IS NULL;

-- Counts of the parts that ended on a day (UTC), a row for each cell and recipe. Accepted at once is the share of the accepted ones that needed no
-- correction. A recipe or a simulation of null is not told. The cell is in the key: cells that end runs at the same time change different rows.
CREATE TABLE parts_of_day (
    day date NOT NULL,
    cell integer NOT NULL REFERENCES cell,
    recipe text,
    simulation boolean,
    accepted integer NOT NULL,
    accepted_at_once integer NOT NULL,
    not_accepted integer NOT NULL,
    stopped integer NOT NULL,
    aborted integer NOT NULL,
    given_up integer NOT NULL,
    UNIQUE NULLS NOT DISTINCT (day, cell, recipe, simulation)
) WITH (fillfactor = 80);

-- Every part that counts, as the tables have it: each run that ended with a result, and each part that was given up and whose run has not ended.
-- The triggers below keep `parts_of_day` equal to its counts.
CREATE VIEW counted_part WITH (security_invoker = true) AS
SELECT (r.ended AT TIME ZONE 'UTC')::date AS day, r.cell, r.recipe, r.simulation, r.result, r.cycles FROM run r
WHERE r.ended IS NOT NULL AND r.result IN ('accepted', 'not accepted', 'stopped', 'aborted')
UNION ALL
SELECT (s.at AT TIME ZONE 'UTC')::date, w.cell, coalesce(r.recipe, p.name), coalesce(r.simulation, s.simulation, false), 'given up', NULL
FROM work_step s JOIN work w ON w.id = s.work JOIN recipe p ON p.sha256 = w.recipe LEFT JOIN run r ON r.cell = w.cell AND r.name = w.run
WHERE s.step = 'given up' AND w.cell IS NOT NULL AND r.ended IS NULL;

-- Counts all parts again, from the runs. Nothing ends meanwhile.
CREATE FUNCTION count_parts_again() RETURNS void LANGUAGE plpgsql SET search_path = regrind, pg_temp AS $$
BEGIN
    LOCK TABLE run, work_step IN SHARE ROW EXCLUSIVE MODE;
    LOCK TABLE parts_of_day IN EXCLUSIVE MODE;
    DELETE FROM parts_of_day;
    INSERT INTO parts_of_day
        SELECT day, cell, recipe, simulation, count(*) FILTER (WHERE result = 'accepted'), count(*) FILTER (WHERE result = 'accepted' AND cycles = 1),
            count(*) FILTER (WHERE result = 'not accepted'), count(*) FILTER (WHERE result = 'stopped'),
            count(*) FILTER (WHERE result = 'aborted'), count(*) FILTER (WHERE result = 'given up')
        FROM counted_part GROUP BY day, cell, recipe, simulation;
END $$;
REVOKE EXECUTE ON FUNCTION count_parts_again() FROM PUBLIC;

-- A part that begins to count, or no longer does: by 1 or -1.
CREATE TYPE part_change AS (day date, cell integer, recipe text, simulation boolean, result text, cycles integer, by integer);

-- Adds changes to the counts: each row once, in the order of its key, so that two transactions never wait for each other.
CREATE FUNCTION add_to_days(changes part_change[]) RETURNS void LANGUAGE sql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
    INSERT INTO parts_of_day AS d
        SELECT * FROM (
            SELECT day, cell, recipe, simulation, coalesce(sum(by) FILTER (WHERE result = 'accepted'), 0) AS accepted,
                coalesce(sum(by) FILTER (WHERE result = 'accepted' AND cycles = 1), 0) AS accepted_at_once,
                coalesce(sum(by) FILTER (WHERE result = 'not accepted'), 0) AS not_accepted,
                coalesce(sum(by) FILTER (WHERE result = 'stopped'), 0) AS stopped, coalesce(sum(by) FILTER (WHERE result = 'aborted'), 0) AS aborted,
                coalesce(sum(by) FILTER (WHERE result = 'given up'), 0) AS given_up
            FROM unnest(changes) GROUP BY day, cell, recipe, simulation) sums
        WHERE (accepted, accepted_at_once, not_accepted, stopped, aborted, given_up) <> (0, 0, 0, 0, 0, 0)
        ORDER BY day, cell, recipe, simulation
    ON CONFLICT (day, cell, recipe, simulation) DO UPDATE SET (accepted, accepted_at_once, not_accepted, stopped, aborted, given_up)
        = (d.accepted + excluded.accepted, d.accepted_at_once + excluded.accepted_at_once, d.not_accepted + excluded.not_accepted,
           d.stopped + excluded.stopped, d.aborted + excluded.aborted, d.given_up + excluded.given_up)
$$;
REVOKE EXECUTE ON FUNCTION add_to_days(part_change[]) FROM PUBLIC;

-- A run as far as it counts, as it became (1) or as it was (-1).
CREATE TYPE run_change AS (cell integer, name text, recipe text, simulation boolean, ended timestamptz, result text, cycles integer, by integer);

-- Counts what changes of runs change: their own results, and whether parts of theirs count as given up.
CREATE FUNCTION count_runs(changes run_change[]) RETURNS void LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
BEGIN
    -- A part of such a run that somebody gives up at this moment: the next statement sees it. The order is everywhere run, work, count.
    PERFORM FROM unnest(changes) c JOIN work w ON w.cell = c.cell AND w.run = c.name ORDER BY w.id FOR SHARE OF w;
    PERFORM add_to_days(array(
        SELECT ROW((c.ended AT TIME ZONE 'UTC')::date, c.cell, c.recipe, c.simulation, c.result, c.cycles, c.by)::part_change FROM unnest(changes) c
        WHERE c.ended IS NOT NULL AND c.result IN ('accepted', 'not accepted', 'stopped', 'aborted')
        UNION ALL
        -- As a part given up counts with such a run, and as it counts without one.
        SELECT ROW((s.at AT TIME ZONE 'UTC')::date, w.cell, coalesce(run.recipe, p.name), coalesce(run.simulation, s.simulation, false), 'given up',
            NULL, run.by)::part_change
        FROM unnest(changes) c JOIN work w ON w.cell = c.cell AND w.run = c.name JOIN work_step s ON s.work = w.id AND s.step = 'given up'
            JOIN recipe p ON p.sha256 = w.recipe
            CROSS JOIN LATERAL (SELECT c.recipe, c.simulation, c.by WHERE c.ended IS NULL UNION ALL SELECT NULL, NULL, -c.by) run));
END $$;
REVOKE EXECUTE ON FUNCTION count_runs(run_change[]) FROM PUBLIC;

CREATE FUNCTION runs_changed() RETURNS trigger LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    changes run_change[];
BEGIN
    IF TG_RELID <> 'regrind.run'::regclass THEN
        RAISE EXCEPTION 'this function is for the table run alone' USING ERRCODE = 'insufficient_privilege';
    END IF;
    IF TG_OP = 'UPDATE' THEN
        changes := array(
            SELECT side.change FROM old_run o JOIN new_run n ON n.id = o.id CROSS JOIN LATERAL (
                VALUES (ROW(o.cell, o.name, o.recipe, o.simulation, o.ended, o.result, o.cycles, -1)::run_change),
                    (ROW(n.cell, n.name, n.recipe, n.simulation, n.ended, n.result, n.cycles, 1)::run_change)) side (change)
            WHERE (o.cell, o.name, o.recipe, o.simulation, o.ended, o.result, o.cycles)
                IS DISTINCT FROM (n.cell, n.name, n.recipe, n.simulation, n.ended, n.result, n.cycles));
    ELSIF TG_OP = 'INSERT' THEN
        changes := array(SELECT ROW(n.cell, n.name, n.recipe, n.simulation, n.ended, n.result, n.cycles, 1)::run_change FROM new_run n);
    ELSE
        changes := array(SELECT ROW(o.cell, o.name, o.recipe, o.simulation, o.ended, o.result, o.cycles, -1)::run_change FROM old_run o);
    END IF;
    IF cardinality(changes) > 0 THEN
        PERFORM count_runs(changes);
    END IF;
    RETURN NULL;
END $$;
-- Once a statement, after `work_ended` of each row.
CREATE TRIGGER runs_inserted AFTER INSERT ON run REFERENCING NEW TABLE AS new_run FOR EACH STATEMENT EXECUTE FUNCTION runs_changed();
CREATE TRIGGER runs_updated AFTER UPDATE ON run REFERENCING OLD TABLE AS old_run NEW TABLE AS new_run FOR EACH STATEMENT
    EXECUTE FUNCTION runs_changed();
CREATE TRIGGER runs_deleted AFTER DELETE ON run REFERENCING OLD TABLE AS old_run FOR EACH STATEMENT EXECUTE FUNCTION runs_changed();

-- Counts a part when it is given up, if its run has not ended.
CREATE FUNCTION given_up() RETURNS trigger LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
BEGIN
    IF TG_RELID <> 'regrind.work_step'::regclass THEN
        RAISE EXCEPTION 'this function is for the table work_step alone' USING ERRCODE = 'insufficient_privilege';
    END IF;
    PERFORM add_to_days(array(
        SELECT ROW((new.at AT TIME ZONE 'UTC')::date, w.cell, coalesce(r.recipe, p.name), coalesce(r.simulation, new.simulation, false), 'given up', NULL, 1)::part_change
        FROM work w JOIN recipe p ON p.sha256 = w.recipe LEFT JOIN run r ON r.cell = w.cell AND r.name = w.run
        WHERE w.id = new.work AND w.cell IS NOT NULL AND r.ended IS NULL));
    RETURN NULL;
END $$;
CREATE TRIGGER given_up AFTER INSERT ON work_step FOR EACH ROW WHEN (new.step = 'given up') EXECUTE FUNCTION given_up();

-- Parts that ended, a row for each day (UTC), cell and recipe. Accepted at the first measurement is the first-pass yield.
CREATE OR REPLACE VIEW parts_by_day WITH (security_invoker = true) AS
SELECT d.day, c.name AS cell, d.recipe, d.simulation, (d.accepted + d.not_accepted + d.stopped + d.aborted + d.given_up)::bigint AS ended,
    d.accepted::bigint AS accepted, d.accepted_at_once::bigint AS accepted_at_once, d.not_accepted, d.stopped, d.aborted, d.given_up
FROM parts_of_day d JOIN cell c ON c.id = d.cell
WHERE d.accepted + d.not_accepted + d.stopped + d.aborted + d.given_up > 0;

-- Every run that made or tried a part, and whether its part was given up: asked of the one part of a run that has not ended, never of all parts.
-- By the number of its cell the newest runs of a cell are found in their order.
CREATE OR REPLACE VIEW part_run WITH (security_invoker = true) AS
SELECT r.id, c.name AS cell, r.name AS run, r.part AS serial, r.part_name, r.recipe, r.recipe_sha256, r.operator, r.simulation, r.began,
    r.ended, r.result, r.verdict, r.cycles, r.pv_um, r.pv_u_um, r.pv_limit_um, r.rms_um, r.rms_u_um, r.rms_limit_um, r.grinder, r.cmm,
    r.wheel, r.probe, r.alarms, r.records, encode(r.head, 'hex') AS head, r.arrived_at,
    r.ended IS NULL AND coalesce((SELECT w.state = 'ended' FROM work w WHERE w.cell = r.cell AND w.run = r.name), false) AS given_up,
    r.cell AS cell_id
FROM run r JOIN cell c ON c.id = r.cell WHERE r.began IS NOT NULL AND r.result IS DISTINCT FROM 'recovery';

ALTER TABLE parts_of_day ENABLE ROW LEVEL SECURITY;
CREATE POLICY everything ON parts_of_day FOR SELECT TO regrind_reader USING (true);
GRANT SELECT ON parts_of_day, counted_part TO regrind_reader;

-- Nothing asks these: `parts_of_day` answers for run_day, the primary key by run for run_artefact_sha256, work_not_over for work_open.
DROP INDEX IF EXISTS run_day, run_artefact_sha256, work_open;

-- Runs by the day (UTC) on which they began: many runs have the same key, which the index then has once, so each takes some ten bytes a run instead of
-- forty. A question names the day and sorts by it, then by the time. Real and simulated runs are never asked together. No index is in descending order:
-- what comes in order fills its pages only in an ascending one, and each is read from both ends.
DROP INDEX run_real, run_began, run_recipe, run_cell_began, run_cell_recipe, run_cmm, run_grinder, run_wheel, run_probe, run_part;
CREATE INDEX run_began ON run (began);
CREATE INDEX run_simulation ON run (simulation, ((began AT TIME ZONE 'UTC')::date));
CREATE INDEX run_recipe ON run (recipe, simulation, ((began AT TIME ZONE 'UTC')::date));
-- The recipe stands last: those of one recipe are found in the index alone, and those of all in their order.
CREATE INDEX run_cell ON run (cell, simulation, ((began AT TIME ZONE 'UTC')::date), recipe);
CREATE INDEX run_cmm ON run (cmm, simulation, ((began AT TIME ZONE 'UTC')::date));
CREATE INDEX run_grinder ON run (grinder, simulation, ((began AT TIME ZONE 'UTC')::date));
CREATE INDEX run_wheel ON run (wheel, simulation, ((began AT TIME ZONE 'UTC')::date));
CREATE INDEX run_probe ON run (probe, simulation, ((began AT TIME ZONE 'UTC')::date));
CREATE INDEX run_part ON run (part text_pattern_ops);

SELECT count_parts_again();
