-- The runs number $1 to $2 of $3, made by $4 cells in the $5 seconds before $6, with the seed $7. A cell makes one recipe for a week.
WITH place AS (
    SELECT n, 1 + floor($4::integer * pg_temp.draw(n, 0, $7::bigint))::integer AS cell_number,
        $6::text::timestamptz - make_interval(secs => 7200 + $5::double precision * ($3::bigint - n) / $3::bigint) AS began
    FROM generate_series($1::bigint, $2::bigint) n
), kind AS (
    SELECT p.*, c.id AS cell, floor(40 * pg_temp.draw(cell_number * 100000::bigint + extract(epoch FROM began)::bigint / 604800, 1, $7::bigint) ^ 2)::integer AS recipe_number,
        pg_temp.draw(n, 2, $7::bigint) AS ending, 1 + floor(3 * pg_temp.draw(n, 3, $7::bigint) ^ 2)::integer AS cycles,
        1.5 + 2.5 * pg_temp.draw(n, 4, $7::bigint) + 1.5 * pg_temp.draw(n, 5, $7::bigint) + 0.5 * pg_temp.draw(cell_number, 6, $7::bigint) AS pv_um,
        make_interval(secs => 1200 + 2400 * pg_temp.draw(n, 7, $7::bigint)) AS lasts
    FROM place p JOIN cell c ON c.name = 'SIMULATION-' || lpad(p.cell_number::text, 4, '0')
), result AS (
    SELECT k.*, CASE WHEN ending < 0.93 THEN 'accepted' WHEN ending < 0.97 THEN 'not accepted' WHEN ending < 0.985 THEN 'stopped'
        WHEN ending < 0.995 THEN 'aborted' ELSE 'open' END AS result FROM kind k
), month AS MATERIALIZED (
    -- The numbers of the month of each run, whose records have a partition of their own.
    SELECT at, reserve_run_ids(at, runs::integer) AS first FROM (
        SELECT date_trunc('month', began AT TIME ZONE 'UTC') AT TIME ZONE 'UTC' AS at, count(*) AS runs FROM result GROUP BY 1 ORDER BY 1) m
), numbered AS (
    SELECT r.*, m.first + row_number() OVER (PARTITION BY m.at ORDER BY n) - 1 AS id
    FROM result r JOIN month m ON m.at = date_trunc('month', r.began AT TIME ZONE 'UTC') AT TIME ZONE 'UTC'
), made AS (
    INSERT INTO run (id, cell, name, part, part_name, recipe, recipe_sha256, operator, simulation, began, ended, arrived_at, result, verdict, pv_limit_um, rms_limit_um, grinder,
        cmm, wheel, probe, alarms, cycles, pv_um, pv_u_um, rms_um, rms_u_um)
    SELECT id, cell, 'SIMULATION-' || $7::bigint || '-' || lpad(n::text, 8, '0'), 'SIMULATION-' || lpad(n::text, 8, '0'), 'Free-form mirror ' || recipe_number,
        'mirror-' || recipe_number, encode(sha256(convert_to('mirror-' || recipe_number, 'UTF8')), 'hex'), 'Operator ' || n % 70, true, began,
        CASE WHEN result <> 'open' THEN began + lasts END, began + lasts, result,
        CASE result WHEN 'accepted' THEN 'ACCEPTED: PV and RMS within tolerance' WHEN 'open' THEN NULL ELSE upper(result) || ': simulated' END, 7, 1,
        'Grinder ' || lpad(cell_number::text, 4, '0'), 'CMM ' || cell_number / 5, 'R ' || 18 + (cell_number + extract(epoch FROM began)::bigint / 2592000) % 4 || '.000 mm',
        'R ' || 1 + cell_number % 3 || '.500 mm', (ending > 0.96)::integer, cycles, pv_um, 0.4, pv_um / 8, 0.03
    FROM numbered ORDER BY n
    RETURNING id, cell, name, part, result, began, cycles, pv_um, rms_um
)
INSERT INTO cycle (run, cycle, verdict, reason, pv_um, pv_u_um, rms_um, rms_u_um, expected_pv_um, map)
SELECT id, k, CASE WHEN k = cycles THEN 'accept' ELSE 'continue' END, CASE WHEN k = cycles THEN '' ELSE 'PV above its limit' END, pv_um * (1 + cycles - k), 0.4,
    rms_um * (1 + cycles - k), 0.03, pv_um * (cycles - k), 'cycle-' || k || '/error_map.csv'
FROM made CROSS JOIN LATERAL generate_series(1, cycles) k
