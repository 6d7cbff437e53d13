//! Layout of the database, version by version, and the roles with their rights.

use tokio_postgres::Client;

use super::error::{PlantError, refused};
use super::link::DatabaseLink;

/// All versions of the layout, each as a migration from the one before. A published migration never changes.
const MIGRATIONS: [(i32, &str); 11] = [
    (1, include_str!("migrations/0001_records.sql")),
    (2, include_str!("migrations/0002_work.sql")),
    (3, include_str!("migrations/0003_views.sql")),
    (4, include_str!("migrations/0004_studies.sql")),
    (5, include_str!("migrations/0005_page.sql")),
    (6, include_str!("migrations/0006_knowledge.sql")),
    (7, include_str!("migrations/0007_yield.sql")),
    (8, include_str!("migrations/0008_queue.sql")),
    (9, include_str!("migrations/0009_limits.sql")),
    (10, include_str!("migrations/0010_months.sql")),
    (11, include_str!("migrations/0011_summary.sql")),
];

/// Groups of roles. Each role that signs in is a member of one group.
const GROUPS: [&str; 4] = ["regrind_cell", "regrind_reader", "regrind_planner", "regrind_worker"];

/// Rights that PostgreSQL gives to everybody and that no member of a plant has: to execute a function that no member is
/// named for, also as a trigger on a table of his own, and to make such a table.
const RIGHTS: &str = "REVOKE EXECUTE ON ALL FUNCTIONS IN SCHEMA regrind FROM PUBLIC;
    GRANT EXECUTE ON FUNCTION regrind.told_number(jsonb), regrind.told_whole(jsonb), regrind.told_truth(jsonb) TO regrind_reader;
    DO $$ BEGIN EXECUTE format('REVOKE TEMPORARY ON DATABASE %I FROM PUBLIC', current_database()); END $$";

/// Key of the advisory lock that stops two programs from changing the layout at once.
const LOCK: i64 = 0x5267_7264_506c_616e;

/// Updates the layout of a database (its tables and functions) to the version of this program. Executes each migration
/// (update script) that the database does not have yet. The database role must be the owner of the database. Returns
/// the version of the layout before the update, then the version after the update. The version of a new database is 0.
///
/// # Errors
/// Fails if the database role has no right to change the layout, or if a later version of Regrind made the layout.
/// Fails if a migration that the database has executed has another SHA-256 than the same migration of this program.
/// Fails if the database cannot be reached.
pub async fn migrate(link: &mut DatabaseLink) -> Result<[i32; 2], PlantError> {
    let failed = refused("its layout");
    let client = link.client_mut();
    let step = client.transaction().await.map_err(&failed)?;
    step.execute("SELECT pg_advisory_xact_lock($1)", &[&LOCK]).await.map_err(&failed)?;
    for group in GROUPS {
        // Roles are common to all databases of the server, so another plant may have made the groups already.
        let make =
            format!("DO $$ BEGIN CREATE ROLE {group} NOLOGIN; EXCEPTION WHEN duplicate_object THEN NULL; END $$");
        step.batch_execute(&make).await.map_err(&failed)?;
    }
    step.batch_execute(
        "CREATE SCHEMA IF NOT EXISTS regrind;
         CREATE TABLE IF NOT EXISTS regrind.migration (version integer PRIMARY KEY, sha256 text NOT NULL,
            applied_at timestamptz NOT NULL DEFAULT now());
         GRANT USAGE ON SCHEMA regrind TO regrind_cell, regrind_reader, regrind_planner, regrind_worker;
         GRANT SELECT ON regrind.migration TO regrind_cell, regrind_reader, regrind_worker;
         GRANT regrind_reader TO regrind_planner;",
    )
    .await
    .map_err(&failed)?;
    let rows =
        step.query("SELECT version, sha256 FROM regrind.migration ORDER BY version", &[]).await.map_err(&failed)?;
    let applied: Vec<(i32, String)> = rows.iter().map(|row| (row.get(0), row.get(1))).collect();
    let before = compare_migrations(&applied)?;
    for (version, text) in &MIGRATIONS[applied.len()..] {
        step.batch_execute(text).await.map_err(&failed)?;
        let sha256 = regrind_journal::sha256_hex(text.as_bytes());
        let put = "INSERT INTO regrind.migration (version, sha256) VALUES ($1, $2)";
        step.execute(put, &[version, &sha256]).await.map_err(&failed)?;
    }
    step.batch_execute(RIGHTS).await.map_err(&failed)?;
    step.commit().await.map_err(&failed)?;
    Ok([before, known()])
}

/// Checks that the layout of a database (its tables and functions) is the one that this program uses.
///
/// # Errors
/// Fails if the version of the layout is older or later than that of this program. Fails if a migration (update script)
/// that the database has executed has another SHA-256 than the same migration of this program. Fails if the database
/// cannot be reached.
pub async fn check_layout(client: &Client) -> Result<(), PlantError> {
    let layout = |found, remedy| PlantError::Layout { found, known: known(), remedy };
    let older = "update it as its owner: regrind plant init";
    let rows = match client.query("SELECT version, sha256 FROM regrind.migration ORDER BY version", &[]).await {
        Ok(rows) => rows,
        // The table or the schema does not exist.
        Err(error) if error.code().is_some_and(|code| ["42P01", "3F000"].contains(&code.code())) => {
            return Err(layout(0, older));
        }
        Err(error) => return Err(refused("the query of its layout")(error)),
    };
    let applied: Vec<(i32, String)> = rows.iter().map(|row| (row.get(0), row.get(1))).collect();
    match compare_migrations(&applied)? {
        found if found < known() => Err(layout(found, older)),
        _ => Ok(()),
    }
}

fn known() -> i32 {
    MIGRATIONS.last().map_or(0, |(version, _)| *version)
}

/// Compares the migrations (update scripts) that a database has executed with those of this program. `applied` contains
/// the version and the SHA-256 of each executed migration, in ascending order of version. Returns the version of the
/// last executed migration, or 0 if `applied` is empty. A database that lacks the newest migrations is not an error.
///
/// # Errors
/// Fails if the database has more migrations than this program. Fails if a migration in `applied` has another version
/// or another SHA-256 than the migration of this program at the same position.
fn compare_migrations(applied: &[(i32, String)]) -> Result<i32, PlantError> {
    for (k, (version, sha256)) in applied.iter().enumerate() {
        match MIGRATIONS.get(k) {
            None => {
                let remedy = "use the version of Regrind that made this layout, or a later one";
                return Err(PlantError::Layout { found: applied[applied.len() - 1].0, known: known(), remedy });
            }
            Some((ours, text)) if ours == version && regrind_journal::sha256_hex(text.as_bytes()) == *sha256 => {}
            Some(_) => return Err(PlantError::ForeignLayout { version: *version }),
        }
    }
    Ok(applied.last().map_or(0, |(version, _)| *version))
}

/// Purpose of the role of a person or a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlantRole {
    /// Reads everything and changes nothing: for the page of the plant, Grafana, and statistics.
    Reader,
    /// Reads everything, puts parts into the queue, and stores recipes.
    Planner,
    /// Makes the simulated runs of studies.
    Worker,
}

impl PlantRole {
    fn group(self) -> &'static str {
        match self {
            Self::Reader => "regrind_reader",
            Self::Planner => "regrind_planner",
            Self::Worker => "regrind_worker",
        }
    }
}

/// Member of a plant that is to be enrolled.
#[derive(Clone, Copy, Debug)]
pub struct NewMember<'a> {
    /// Name in the plant.
    pub name: &'a str,
    /// Name of the database role.
    pub role: &'a str,
    /// Password of the role.
    pub password: &'a str,
    /// True if the member is enrolled already: it gets a new password, and its retirement ends. Otherwise a member that is
    /// enrolled already is refused.
    pub is_again: bool,
}

/// Registers a cell in the plant. Creates its database role, and stores the public `keys` that may sign the records of the
/// cell, in addition to those that it has.
///
/// # Errors
/// Fails as [`enrol`] does, or if another cell has the role.
pub async fn enrol_cell(link: &mut DatabaseLink, cell: NewMember<'_>, keys: &[String]) -> Result<(), PlantError> {
    let failed = refused("to enrol the cell");
    let NewMember { name, role, .. } = cell;
    let step = link.client_mut().transaction().await.map_err(&failed)?;
    let other = "SELECT name FROM regrind.cell WHERE role = $2::text::name AND name <> $1";
    if let Some(row) = step.query_opt(other, &[&name, &role]).await.map_err(&failed)? {
        let what =
            format!("the cell {} has the role {role} already; give this cell another name", row.get::<_, &str>(0));
        return Err(PlantError::Member { name: name.to_owned(), what });
    }
    make_role(&step, cell, "regrind_cell").await?;
    step.execute(
        "INSERT INTO regrind.cell (name, role) VALUES ($1, $2::text::name) ON CONFLICT (name) DO UPDATE SET role = excluded.role, retired_at = NULL",
        &[&name, &role],
    )
    .await
    .map_err(&failed)?;
    store_keys(&step, name, keys).await?;
    step.commit().await.map_err(&failed)
}

/// Stores further public `keys` that may sign the records of the cell `name`. Its password stays. Returns false if there
/// is no such cell.
///
/// # Errors
/// Fails if the database role of the caller has no right to do so, or if the database cannot be reached.
pub async fn add_cell_keys(link: &mut DatabaseLink, name: &str, keys: &[String]) -> Result<bool, PlantError> {
    let failed = refused("to store a key");
    let step = link.client_mut().transaction().await.map_err(&failed)?;
    let known = step.query_opt("SELECT 1 FROM regrind.cell WHERE name = $1", &[&name]).await.map_err(&failed)?;
    if known.is_none() {
        return Ok(false);
    }
    store_keys(&step, name, keys).await?;
    step.commit().await.map_err(&failed)?;
    Ok(true)
}

async fn store_keys(step: &tokio_postgres::Transaction<'_>, name: &str, keys: &[String]) -> Result<(), PlantError> {
    let text = "INSERT INTO regrind.cell_key (cell, key) SELECT id, $2 FROM regrind.cell WHERE name = $1 ON CONFLICT DO NOTHING";
    for key in keys {
        step.execute(text, &[&name, key]).await.map_err(refused("to store a key"))?;
    }
    Ok(())
}

/// Creates the database role of a person or a program. `of` is the purpose of the role; it determines the rights.
///
/// # Errors
/// Fails if the role exists and the member is not enrolled again, if it is of another kind, or if Regrind did not make it.
/// Fails if the database role of the caller has no right to create roles, or if the database cannot be reached.
pub async fn enrol(link: &mut DatabaseLink, member: NewMember<'_>, of: PlantRole) -> Result<(), PlantError> {
    let failed = refused("to enrol the role");
    let step = link.client_mut().transaction().await.map_err(&failed)?;
    make_role(&step, member, of.group()).await?;
    step.commit().await.map_err(&failed)
}

/// Creates the database role of a member as a member of `group`, or gives a role that is one already a new password.
/// `step` is the open transaction.
///
/// SQL commands for roles accept no query parameters. Therefore the server first builds the commands with quoted names
/// and password, and then executes them.
async fn make_role(
    step: &tokio_postgres::Transaction<'_>,
    member: NewMember<'_>,
    group: &str,
) -> Result<(), PlantError> {
    let NewMember { name, role, password, is_again } = member;
    let failed = refused("to make the role");
    let refused_member = |what: String| Err(PlantError::Member { name: name.to_owned(), what });
    let known = "SELECT array(SELECT g.rolname::text FROM pg_auth_members m JOIN pg_roles g ON g.oid = m.roleid WHERE m.member = r.oid)
        FROM pg_roles r WHERE rolname = $1::text::name";
    let groups = step.query_opt(known, &[&role]).await.map_err(&failed)?.map(|row| row.get::<_, Vec<String>>(0));
    let text = match groups.as_deref() {
        // Its other rights were given when it was made. Only a superuser may state them again.
        Some([only]) if only == group && is_again => {
            "SELECT format('ALTER ROLE %I LOGIN PASSWORD %L', $1::text, $2::text) WHERE $3::text IS NOT NULL"
        }
        Some([only]) if only == group => {
            return refused_member(
                "it is enrolled already; --again gives it a new password, and ends a retirement".into(),
            );
        }
        Some(groups) => {
            let what = match groups.iter().find_map(|group| group.strip_prefix("regrind_")) {
                Some(kind) => format!("the role {role} is that of a {kind}; choose another name"),
                None => format!("the database has a role {role} that Regrind did not make; choose another name"),
            };
            return refused_member(what);
        }
        None if is_again => return refused_member("it is not enrolled; leave out --again".into()),
        None => {
            "SELECT format('CREATE ROLE %I LOGIN NOSUPERUSER NOCREATEDB NOCREATEROLE NOREPLICATION NOBYPASSRLS CONNECTION LIMIT %s PASSWORD %L',
                $1::text, CASE $3::text WHEN 'regrind_cell' THEN 12 ELSE -1 END, $2::text)"
        }
    };
    let made = step.query_one(text, &[&role, &password, &group]).await.map_err(&failed)?;
    step.batch_execute(made.get(0)).await.map_err(&failed)?;
    if groups.is_none() {
        let grant = step.query_one("SELECT format('GRANT %I TO %I', $1::text, $2::text)", &[&group, &role]).await;
        step.batch_execute(grant.map_err(&failed)?.get(0)).await.map_err(&failed)?;
    }
    Ok(())
}

/// Retires a cell: its role cannot sign in any more, and its records stay. Returns false if there is no such cell, or
/// if it is retired already.
///
/// # Errors
/// The database role has no right to retire a cell, or the database cannot be reached.
pub async fn retire_cell(link: &mut DatabaseLink, name: &str) -> Result<bool, PlantError> {
    let failed = refused("to retire the cell");
    let step = link.client_mut().transaction().await.map_err(&failed)?;
    let text = "UPDATE regrind.cell SET retired_at = now() WHERE name = $1 AND retired_at IS NULL RETURNING format('ALTER ROLE %I NOLOGIN', role)";
    let Some(row) = step.query_opt(text, &[&name]).await.map_err(&failed)? else { return Ok(false) };
    step.batch_execute(row.get(0)).await.map_err(&failed)?;
    step.commit().await.map_err(&failed)?;
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::MIGRATIONS;
    use regrind_formats::run_files::RunFile;

    /// A database names the hash of each script that made it: a script that was published keeps every byte.
    #[test]
    fn published_migrations_are_unchanged() {
        let published = [
            "8edafe1caaad074088738da0afae3b84541f356c1b791cd2ff504ee3dc941d28",
            "9ce8793c42b61a06505809ddd6e8968c4757643ac623a747265e8c7f79703f98",
            "5cf97c13d4a9e726dbbd3b0da4131420647542ea6126dfbd7f8d5d175006da9f",
            "602439e08e5842bd68a52893d3690ef6416772956a34576ab88c858277606a9b",
            "2906050ef4bd722502107c1b28ec71b3291695e8a2fce3d42cd34cede06862c3",
            "2c57ee011b6fe64810a8b69752e14ce4bafae8fa721647b4fcc82c8abc779525",
            "ee139ae30be641061b84910364560728186072743559e0e172d25955ddbc5463",
            "ac9dcd30068d60910300bd350c55ce73d263f4dd85cd93aaa56940b34875dadd",
            "21d3b552cf46f2275d50647c1817a48a823ca1f4e4a74de8e19d1a32d3ffcda0",
            "408a9f3a040dc3aee8451d8d91dbcc5519b07624d0ed2c0f5e6953a46d9cdba2",
            "9309271c50855a2e0fd942a4134fda052158bb6bcee9a3bf356714ec359a5753",
        ];
        for ((version, text), sha256) in MIGRATIONS.iter().zip(published) {
            assert_eq!(regrind_journal::sha256_hex(text.as_bytes()), sha256, "migration {version}");
        }
    }

    #[test]
    fn migration_names_learned_file() {
        let name = format!("a.name = '{}'", RunFile::Learned.name());
        assert!(MIGRATIONS.iter().any(|(_, text)| text.contains(&name)), "{name}");
    }
}
