-- Gives runs the figures of a whole one: $1 their ids, $2 the first record of each, $3 the time of the last one, $4 the number of records, $5 the hash of the
-- last one, $6 what the record of all of them says.
WITH whole AS (
    SELECT * FROM unnest($1::integer[], $2::text[], $3::text[], $4::integer[], $5::bytea[]) AS w (id, first, ended, records, head)
), told AS (
    SELECT w.*, w.first::json AS begin, w.first::json -> 'payload' -> 'content' AS content, $6::text::jsonb AS told,
        (SELECT c FROM jsonb_array_elements($6::text::jsonb -> 'cycles') AS c WHERE c -> 'pv_um' <> 'null' ORDER BY (c ->> 'cycle')::integer DESC LIMIT 1) AS last
    FROM whole w
), old AS (
    DELETE FROM cycle c USING whole w WHERE c.run = w.id AND c.cycle > jsonb_array_length($6::text::jsonb -> 'cycles')
), judged AS (
    INSERT INTO cycle (run, cycle, verdict, reason, pv_um, pv_u_um, rms_um, rms_u_um, expected_pv_um, expected_rms_um, map)
    SELECT w.id, f.* FROM whole w CROSS JOIN jsonb_to_recordset($6::text::jsonb -> 'cycles') AS f (cycle integer, verdict text, reason text,
        pv_um double precision, pv_u_um double precision, rms_um double precision, rms_u_um double precision, expected_pv_um double precision,
        expected_rms_um double precision, map text)
    ON CONFLICT (run, cycle) DO UPDATE SET (verdict, reason, pv_um, pv_u_um, rms_um, rms_u_um, expected_pv_um, expected_rms_um, map)
        = (excluded.verdict, excluded.reason, excluded.pv_um, excluded.pv_u_um, excluded.rms_um, excluded.rms_u_um,
           excluded.expected_pv_um, excluded.expected_rms_um, excluded.map)
)
UPDATE run r SET records = t.records, head = t.head, operator = t.begin ->> 'actor', began = (t.begin ->> 'utc')::timestamptz, ended = t.ended::timestamptz, arrived_at = t.ended::timestamptz,
    part_name = t.content ->> 'part_name', recipe_sha256 = t.content ->> 'recipe_sha256',
    recipe = regexp_replace(t.content ->> 'recipe', '^.*[/\\]|\.toml$', '', 'g'), result = t.told ->> 'result', verdict = t.told ->> 'verdict',
    pv_limit_um = (t.told ->> 'pv_limit_um')::double precision, rms_limit_um = (t.told ->> 'rms_limit_um')::double precision, grinder = t.told ->> 'grinder',
    cmm = t.told ->> 'cmm', wheel = t.told ->> 'wheel', probe = t.told ->> 'probe', alarms = (t.told ->> 'alarms')::integer,
    cycles = jsonb_array_length(t.told -> 'cycles'), pv_um = (t.last ->> 'pv_um')::double precision, pv_u_um = (t.last ->> 'pv_u_um')::double precision,
    rms_um = (t.last ->> 'rms_um')::double precision, rms_u_um = (t.last ->> 'rms_u_um')::double precision
FROM told t WHERE r.id = t.id
