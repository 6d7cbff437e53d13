-- Cells that nobody signs in as: $1 is their number, $2 the seed. Each shows its last known state.
WITH made AS (
    INSERT INTO cell (name, role) SELECT 'SIMULATION-' || lpad(n::text, 4, '0'), ('SIMULATION-' || lpad(n::text, 4, '0'))::name
    FROM generate_series(1, $1::integer) n ON CONFLICT DO NOTHING RETURNING id
)
INSERT INTO cell_state (cell, at, run, snapshot)
SELECT id, now() - make_interval(secs => 40 * pg_temp.draw(id, 40, $2::bigint)), NULL, jsonb_build_object('state', 'Execute', 'words', 'grinding', 'simulation', true,
    'part', 'Free-form mirror', 'serial', 'SIMULATION-' || id, 'cycle', 1 + floor(3 * pg_temp.draw(id, 41, $2::bigint)), 'max_cycles', 6,
    'progress', jsonb_build_object('device', 'Grinder', 'done', floor(300 * pg_temp.draw(id, 42, $2::bigint)), 'total', 300, 'left_s', jsonb_build_array(80, 130)),
    'alarms', '[]'::jsonb)
FROM made
