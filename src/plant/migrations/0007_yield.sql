-- Parts that were given up count in the yields: their run has no end, and none of them is good.

CREATE INDEX work_step_given_up ON work_step (at) WHERE step = 'given up';

-- Every part that was given up and whose run has not ended. Whether it was simulated, its run says, or the newest run of its cell.
CREATE VIEW part_given_up WITH (security_invoker = true) AS
SELECT w.id AS work, c.name AS cell, w.run, w.serial, coalesce(r.recipe, p.name) AS recipe,
    coalesce(r.simulation, (SELECT n.simulation FROM run n WHERE n.cell = w.cell ORDER BY n.began DESC NULLS LAST LIMIT 1), false) AS simulation,
    r.began, s.at AS given_up, s.words AS reason
FROM work_step s JOIN work w ON w.id = s.work JOIN cell c ON c.id = w.cell JOIN recipe p ON p.sha256 = w.recipe
    LEFT JOIN run r ON r.cell = w.cell AND r.name = w.run
WHERE s.step = 'given up' AND r.ended IS NULL;

-- Every run that made or tried a part, and whether its part was given up.
CREATE OR REPLACE VIEW part_run WITH (security_invoker = true) AS
SELECT r.id, c.name AS cell, r.name AS run, r.part AS serial, r.part_name, r.recipe, r.recipe_sha256, r.operator, r.simulation, r.began,
    r.ended, r.result, r.verdict, r.cycles, r.pv_um, r.pv_u_um, r.pv_limit_um, r.rms_um, r.rms_u_um, r.rms_limit_um, r.grinder, r.cmm,
    r.wheel, r.probe, r.alarms, r.records, encode(r.head, 'hex') AS head, r.arrived_at,
    r.ended IS NULL AND EXISTS (SELECT FROM work w WHERE w.cell = r.cell AND w.run = r.name AND w.state = 'ended') AS given_up
FROM run r JOIN cell c ON c.id = r.cell WHERE r.began IS NOT NULL AND r.result IS DISTINCT FROM 'recovery';

-- Parts that ended, a row for each day (UTC), cell and recipe. Accepted at the first measurement is the first-pass yield.
CREATE OR REPLACE VIEW parts_by_day WITH (security_invoker = true) AS
SELECT day, cell, recipe, simulation, sum(ended)::bigint AS ended, sum(accepted)::bigint AS accepted, sum(accepted_at_once)::bigint AS accepted_at_once
FROM (
    SELECT (r.ended AT TIME ZONE 'UTC')::date AS day, c.name AS cell, r.recipe, r.simulation, count(*) AS ended,
        count(*) FILTER (WHERE r.result = 'accepted') AS accepted,
        count(*) FILTER (WHERE r.result = 'accepted' AND r.cycles = 1) AS accepted_at_once
    FROM run r JOIN cell c ON c.id = r.cell
    WHERE r.ended IS NOT NULL AND r.result IN ('accepted', 'not accepted', 'stopped', 'aborted')
    GROUP BY 1, 2, 3, 4
    UNION ALL
    SELECT (given_up AT TIME ZONE 'UTC')::date, cell, recipe, simulation, count(*), 0, 0 FROM part_given_up GROUP BY 1, 2, 3, 4
) counted GROUP BY 1, 2, 3, 4;

GRANT SELECT ON part_given_up TO regrind_reader;
