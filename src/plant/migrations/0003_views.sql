-- What people ask: each view is read with the rights of who reads it, by a program of the shop or by Grafana.

-- What a cell tells of itself is its own word: of what is not what it should be nothing is taken, and nobody else is the worse for it.
CREATE FUNCTION told_number(told jsonb) RETURNS double precision LANGUAGE sql IMMUTABLE AS $$
    SELECT CASE WHEN jsonb_typeof(told) = 'number' AND abs(told::numeric) < 1e300 THEN told::numeric::double precision END
$$;
CREATE FUNCTION told_whole(told jsonb) RETURNS integer LANGUAGE sql IMMUTABLE AS $$
    SELECT CASE WHEN jsonb_typeof(told) = 'number' AND told::numeric BETWEEN 0 AND 2147483647 THEN told::numeric::integer END
$$;
CREATE FUNCTION told_truth(told jsonb) RETURNS boolean LANGUAGE sql IMMUTABLE AS $$
    SELECT CASE WHEN jsonb_typeof(told) = 'boolean' THEN told::boolean END
$$;

-- Every cell at a glance. Times left are of the job under way, in seconds.
CREATE VIEW cell_now WITH (security_invoker = true) AS
SELECT c.name AS cell, s.at AS told_at, s.run, s.snapshot ->> 'state' AS state, s.snapshot ->> 'words' AS words,
    told_truth(s.snapshot -> 'simulation') AS simulation, s.snapshot ->> 'part' AS part_name, s.snapshot ->> 'serial' AS serial,
    told_whole(s.snapshot -> 'cycle') AS cycle, told_whole(s.snapshot -> 'max_cycles') AS most_cycles,
    told_whole(s.snapshot #> '{progress,done}') AS done, told_whole(s.snapshot #> '{progress,total}') AS total,
    told_number(s.snapshot #> '{progress,left_s,0}') AS left_least_s, told_number(s.snapshot #> '{progress,left_s,1}') AS left_most_s,
    CASE jsonb_typeof(s.snapshot -> 'alarms') WHEN 'array' THEN jsonb_array_length(s.snapshot -> 'alarms') ELSE 0 END AS alarms, s.snapshot ->> 'next' AS next, s.snapshot
FROM cell c LEFT JOIN cell_state s ON s.cell = c.id WHERE c.retired_at IS NULL;

-- Every run that made or tried a part.
CREATE VIEW part_run WITH (security_invoker = true) AS
SELECT r.id, c.name AS cell, r.name AS run, r.part AS serial, r.part_name, r.recipe, r.recipe_sha256, r.operator, r.simulation, r.began,
    r.ended, r.result, r.verdict, r.cycles, r.pv_um, r.pv_u_um, r.pv_limit_um, r.rms_um, r.rms_u_um, r.rms_limit_um, r.grinder, r.cmm,
    r.wheel, r.probe, r.alarms, r.records, encode(r.head, 'hex') AS head, r.arrived_at
FROM run r JOIN cell c ON c.id = r.cell WHERE r.began IS NOT NULL AND r.result IS DISTINCT FROM 'recovery';

-- Parts that ended, a row for each day (UTC), cell and recipe. Accepted at the first measurement is the first-pass yield.
CREATE VIEW parts_by_day WITH (security_invoker = true) AS
SELECT (r.ended AT TIME ZONE 'UTC')::date AS day, c.name AS cell, r.recipe, r.simulation, count(*) AS ended,
    count(*) FILTER (WHERE r.result = 'accepted') AS accepted,
    count(*) FILTER (WHERE r.result = 'accepted' AND r.cycles = 1) AS accepted_at_once
FROM run r JOIN cell c ON c.id = r.cell
WHERE r.ended IS NOT NULL AND r.result IN ('accepted', 'not accepted', 'stopped', 'aborted')
GROUP BY 1, 2, 3, 4;

-- Every cycle that was judged.
CREATE VIEW cycle_figure WITH (security_invoker = true) AS
SELECT r.id AS run_id, c.name AS cell, r.name AS run, r.part AS serial, r.recipe, r.grinder, r.cmm, r.wheel, r.probe, r.simulation, r.began,
    y.cycle, y.verdict, y.reason, y.pv_um, y.pv_u_um, r.pv_limit_um, y.rms_um, y.rms_u_um, r.rms_limit_um, y.expected_pv_um,
    y.expected_rms_um, y.map
FROM cycle y JOIN run r ON r.id = y.run JOIN cell c ON c.id = r.cell;

-- The queue, as far as it is not over.
CREATE VIEW work_now WITH (security_invoker = true) AS
SELECT w.id, w.serial, p.name AS recipe, p.version, encode(w.recipe, 'hex') AS recipe_sha256, f.name AS for_cell, w.due, w.state,
    c.name AS cell, w.leased_until, w.run, w.queued_at, w.queued_by
FROM work w JOIN recipe p ON p.sha256 = w.recipe LEFT JOIN cell f ON f.id = w.for_cell LEFT JOIN cell c ON c.id = w.cell
WHERE w.state IN ('open', 'leased', 'begun');

GRANT SELECT ON cell_now, part_run, parts_by_day, cycle_figure, work_now TO regrind_reader;
