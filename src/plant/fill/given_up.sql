-- Gives up the parts of the runs whose name begins with $1 and that did not end, and puts nothing else into the queue.
WITH given_up AS (
    INSERT INTO work (serial, recipe, state, cell, run, begun_at)
    SELECT part, recipe_sha256('SIMULATION', 1, 'SIMULATION', '{}'), 'ended', cell, name, began FROM run WHERE starts_with(name, $1) AND ended IS NULL RETURNING id, begun_at
)
INSERT INTO work_step (work, at, step, words, simulation) SELECT id, begun_at + interval '1 hour', 'given up', 'SIMULATION', true FROM given_up
