//! Restoring a plant from its backup on another computer: it is evidence as before, and its cells continue with it.

use std::fs;
use std::io::Write;
use std::process::Stdio;

use super::records::made;
use crate::Plant;
use crate::postgres::Postgres;

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn plant_restored_from_backup() {
    let mut plant = Plant::new();
    let (_, name) = made(&plant);
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    // As docs/plant.md describes it: the roles, and the database.
    let roles = plant.postgres.tool("pg_dumpall").arg("--globals-only").output().unwrap();
    let dump = plant.path("regrind.dump");
    let dumped = plant
        .postgres
        .tool("pg_dump")
        .args(["--format=custom", "--dbname=regrind", "--file"])
        .arg(&dump)
        .output()
        .unwrap();
    assert!(roles.status.success() && dumped.status.success(), "{}", String::from_utf8_lossy(&dumped.stderr));
    let count = plant.sql("SELECT count(*) FROM record");

    let other = Postgres::start();
    let mut psql = other
        .tool("psql")
        .args(["--quiet", "--dbname=postgres"])
        .stdin(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    psql.stdin.take().unwrap().write_all(&roles.stdout).unwrap();
    // The owner exists already. The error message does not matter.
    psql.wait().unwrap();
    let restored = other.tool("pg_restore").args(["--dbname=regrind", "--exit-on-error"]).arg(&dump).output().unwrap();
    assert!(restored.status.success(), "{}", String::from_utf8_lossy(&restored.stderr));

    // The plant files point to the other computer; nothing else is changed.
    let [from, to] = [&plant.postgres, &other].map(|server| server.socket().display().to_string());
    for file in ["owner.toml", "cell-1.toml"] {
        let text = fs::read_to_string(plant.path(file)).unwrap();
        fs::write(plant.path(file), text.replace(&from, &to)).unwrap();
    }
    plant.postgres.kill();
    assert!(plant.does(&["plant", "init", "--plant", "owner.toml"]).contains("unchanged"));
    plant.does(&["audit", "verify", "--plant", "cell-1.toml"]);
    plant.does(&["plant", "fetch", &name, "--plant", "owner.toml", "--out", "back"]);
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    assert_eq!(other.sql("regrind", "SELECT count(*) FROM regrind.record"), count);
    // The rights were restored too.
    assert!(other.ask_as("cell_1", &plant.password("cell-1"), "regrind", "DELETE FROM regrind.record").is_err());
}
