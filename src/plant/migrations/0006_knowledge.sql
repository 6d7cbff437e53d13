-- Knowledge: what the runs of a cell have learned of a recipe, for the first part of it on another.

-- What a finished run taught: its learned.json, and what another run has to have in common with it.
CREATE TABLE lesson (
    run integer PRIMARY KEY REFERENCES run,
    cell integer NOT NULL REFERENCES cell,
    kind text NOT NULL CHECK (length(kind) BETWEEN 1 AND 8000),
    simulation boolean NOT NULL,
    sha256 bytea NOT NULL,
    at timestamptz NOT NULL DEFAULT now()
);
-- Kinds are long: by their hash, which an index can hold.
CREATE INDEX lesson_kind ON lesson (md5(kind), simulation, cell);
CREATE INDEX lesson_cell ON lesson (cell);

-- Takes what a run of the cell has taught. Answers why not, where it does not.
CREATE FUNCTION teach(of_run integer, of_kind text, of_sha256 bytea) RETURNS text
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
    r run%ROWTYPE;
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
    INSERT INTO lesson (run, cell, kind, simulation, sha256) VALUES (of_run, mine, of_kind, r.simulation, of_sha256) ON CONFLICT DO NOTHING;
    RETURN NULL;
END $$;

-- What runs have taught, the newest of each cell of each kind, with their contents. None is larger than 4 MB.
CREATE VIEW newest_lesson AS
    SELECT DISTINCT ON (l.cell, md5(l.kind), l.simulation)
        l.kind, l.simulation, l.cell, c.name AS cell_name, r.name AS run, r.ended, l.sha256, a.content, a.place
    FROM lesson l JOIN run r ON r.id = l.run JOIN cell c ON c.id = l.cell JOIN artefact a ON a.sha256 = l.sha256
    WHERE a.bytes <= 4194304
    ORDER BY l.cell, md5(l.kind), l.simulation, r.ended DESC;

-- What other cells have taught of a kind, the newest eight.
CREATE FUNCTION lessons(of_kind text, of_simulation boolean)
RETURNS TABLE (cell text, run text, sha256 bytea, content bytea, place text)
LANGUAGE plpgsql STABLE SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
BEGIN
    RETURN QUERY SELECT n.cell_name, n.run, n.sha256, n.content, n.place FROM newest_lesson n
        WHERE md5(n.kind) = md5(of_kind) AND n.kind = of_kind AND n.simulation = of_simulation AND n.cell <> mine
        ORDER BY n.ended DESC LIMIT 8;
END $$;

-- What cells have taught of the kinds that two of them know, by which machines are compared: those of this cell first, eight kinds and four cells
-- of each at most, this one among them.
CREATE FUNCTION lessons_in_common(of_simulation boolean)
RETURNS TABLE (kind text, is_own boolean, cell text, run text, sha256 bytea, content bytea, place text)
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
        SELECT k.kind, k.cell = mine, k.cell_name, k.run, k.sha256, k.content, k.place FROM ranked k
        WHERE k.place_of <= 4 ORDER BY k.is_ours DESC, k.newest DESC, k.kind, k.place_of;
END $$;

ALTER TABLE lesson ENABLE ROW LEVEL SECURITY;
CREATE POLICY own ON lesson FOR SELECT TO regrind_cell USING (cell = (SELECT own_cell()));
CREATE POLICY everything ON lesson FOR SELECT TO regrind_reader USING (true);

-- The view reads as its owner does: it is for the functions alone.
GRANT SELECT ON lesson TO regrind_cell, regrind_reader;
REVOKE ALL ON newest_lesson FROM PUBLIC;
REVOKE EXECUTE ON FUNCTION teach(integer, text, bytea), lessons(text, boolean), lessons_in_common(boolean) FROM PUBLIC;
GRANT EXECUTE ON FUNCTION teach(integer, text, bytea), lessons(text, boolean), lessons_in_common(boolean) TO regrind_cell;
