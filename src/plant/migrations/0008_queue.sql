-- A queue in which no cell holds up the others: a part whose recipe a cell cannot prove waits behind the others, and no cell leases more
-- parts than it can make.

CREATE OR REPLACE FUNCTION take_work(seconds integer)
RETURNS TABLE (id bigint, serial text, recipe bytea, due date, lease integer, until timestamptz)
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
#variable_conflict use_column
DECLARE
    -- A cell makes one part at a time. A program that died leaves its lease until it ends.
    most constant integer := 3;
    mine integer := must_be_a_cell();
    found work%ROWTYPE;
BEGIN
    IF (SELECT count(*) FROM work w WHERE w.cell = mine AND w.state = 'leased' AND w.leased_until >= now()) >= most THEN
        RAISE EXCEPTION 'this cell has % parts leased that it has not begun', most
            USING ERRCODE = 'insufficient_privilege', HINT = 'begin them, give them back, or wait until the leases end';
    END IF;
    -- What this cell has refused comes last: it is tried again, for its recipe can be signed meanwhile.
    SELECT * INTO found FROM work w
        WHERE (w.state = 'open' OR (w.state = 'leased' AND w.leased_until < now()))
            AND (w.for_cell IS NULL OR w.for_cell = mine) AND is_approved(w.recipe)
        ORDER BY EXISTS (SELECT FROM work_step s WHERE s.work = w.id AND s.step = 'recipe refused' AND s.role = session_user),
            w.due NULLS LAST, w.id LIMIT 1 FOR UPDATE SKIP LOCKED;
    IF found.id IS NULL THEN
        RETURN;
    END IF;
    UPDATE work w SET state = 'leased', cell = mine, lease = w.lease + 1,
        leased_until = now() + make_interval(secs => least(greatest(seconds, 1), 86400)) WHERE w.id = found.id RETURNING * INTO found;
    INSERT INTO work_step (work, step, lease) VALUES (found.id, 'leased', found.lease);
    RETURN QUERY SELECT found.id, found.serial, found.recipe, found.due, found.lease, found.leased_until;
END $$;

-- Gives a leased part back because the cell cannot prove its recipe. Another cell may know who signed it.
CREATE FUNCTION refuse_recipe(of_work bigint, of_lease integer, why text) RETURNS text
LANGUAGE plpgsql SECURITY DEFINER SET search_path = regrind, pg_temp AS $$
DECLARE
    mine integer := must_be_a_cell();
BEGIN
    UPDATE work SET state = 'open', cell = NULL, leased_until = NULL WHERE id = of_work AND state = 'leased' AND cell = mine AND lease = of_lease;
    IF NOT FOUND THEN
        RETURN refuse_work(of_work, of_lease, 'return', 'its lease is over, or another cell has it');
    END IF;
    INSERT INTO work_step (work, step, lease, words) VALUES (of_work, 'recipe refused', of_lease, left(why, 300));
    RETURN NULL;
END $$;

REVOKE EXECUTE ON FUNCTION refuse_recipe(bigint, integer, text) FROM PUBLIC;
GRANT EXECUTE ON FUNCTION refuse_recipe(bigint, integer, text) TO regrind_cell;
