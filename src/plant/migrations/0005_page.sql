-- What the page of the plant and Grafana ask beside the views of 0003, and the indexes that keep each question short whatever there is.

-- Parts by day: the index alone answers.
CREATE INDEX run_day ON run (((ended AT TIME ZONE 'UTC')::date)) INCLUDE (ended, cell, recipe, simulation, result, cycles)
    WHERE ended IS NOT NULL;
-- The newest of each machine, wheel and probe, and of each recipe at a cell.
CREATE INDEX run_cmm ON run (cmm, began DESC);
CREATE INDEX run_grinder ON run (grinder, began DESC);
CREATE INDEX run_wheel ON run (wheel, began DESC);
CREATE INDEX run_probe ON run (probe, began DESC);
CREATE INDEX run_cell_recipe ON run (cell, recipe, began DESC);
-- Whether anything but simulations was ever made here.
CREATE INDEX run_real ON run (began DESC) WHERE NOT simulation;
CREATE INDEX work_not_over ON work (due NULLS LAST, id) WHERE state IN ('open', 'leased', 'begun');

-- By what parts can be told apart: every name of each kind, found from one to the next in an index instead of in all runs.
CREATE VIEW choice WITH (security_invoker = true) AS
SELECT 'cell' AS kind, name FROM cell WHERE retired_at IS NULL
UNION ALL
SELECT 'recipe', name FROM (
    WITH RECURSIVE found AS (
        SELECT (SELECT min(recipe) FROM run) AS name
        UNION ALL SELECT (SELECT min(r.recipe) FROM run r WHERE r.recipe > found.name) FROM found WHERE found.name IS NOT NULL)
    SELECT name FROM found WHERE name IS NOT NULL) of_recipe
UNION ALL
SELECT 'cmm', name FROM (
    WITH RECURSIVE found AS (
        SELECT (SELECT min(cmm) FROM run) AS name
        UNION ALL SELECT (SELECT min(r.cmm) FROM run r WHERE r.cmm > found.name) FROM found WHERE found.name IS NOT NULL)
    SELECT name FROM found WHERE name IS NOT NULL) of_cmm
UNION ALL
SELECT 'grinder', name FROM (
    WITH RECURSIVE found AS (
        SELECT (SELECT min(grinder) FROM run) AS name
        UNION ALL SELECT (SELECT min(r.grinder) FROM run r WHERE r.grinder > found.name) FROM found WHERE found.name IS NOT NULL)
    SELECT name FROM found WHERE name IS NOT NULL) of_grinder
UNION ALL
SELECT 'wheel', name FROM (
    WITH RECURSIVE found AS (
        SELECT (SELECT min(wheel) FROM run) AS name
        UNION ALL SELECT (SELECT min(r.wheel) FROM run r WHERE r.wheel > found.name) FROM found WHERE found.name IS NOT NULL)
    SELECT name FROM found WHERE name IS NOT NULL) of_wheel
UNION ALL
SELECT 'probe', name FROM (
    WITH RECURSIVE found AS (
        SELECT (SELECT min(probe) FROM run) AS name
        UNION ALL SELECT (SELECT min(r.probe) FROM run r WHERE r.probe > found.name) FROM found WHERE found.name IS NOT NULL)
    SELECT name FROM found WHERE name IS NOT NULL) of_probe;

-- What should not have been, in the names of people.
CREATE VIEW incident_told WITH (security_invoker = true) AS
SELECT i.id, i.at, i.role::text AS by, c.name AS cell, i.run, i.what, i.words FROM incident i LEFT JOIN cell c ON c.id = i.cell;

GRANT SELECT ON choice, incident_told TO regrind_reader;
