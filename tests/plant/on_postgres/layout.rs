//! Layout of the database, and its migrations.

use crate::Plant;

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn unknown_database_layout_refused() {
    let plant = Plant::new();
    let init = ["plant", "init", "--plant", "owner.toml"];
    assert!(plant.does(&init).contains("unchanged"));
    plant.cell("cell-1", &[]);
    let ship = ["ship", "--once", "--plant", "cell-1.toml"];
    plant.sql("INSERT INTO migration (version, sha256) VALUES (99, 'x')");
    for arguments in [&init, &ship] {
        let (_, told) = plant.ends(arguments, 2);
        assert!(told.contains("layout 99") && told.contains("version of Regrind"), "{told}");
    }
    plant.sql("DELETE FROM migration WHERE version = 99");
    plant.sql("UPDATE migration SET sha256 = 'x' WHERE version = 2");
    let (_, told) = plant.ends(&ship, 2);
    assert!(told.contains("migration 2 "), "{told}");
    plant.sql("DELETE FROM migration");
    let (_, told) = plant.ends(&ship, 2);
    assert!(told.contains("regrind plant init"), "{told}");
    plant.sql("DROP SCHEMA regrind CASCADE");
    let (_, told) = plant.ends(&ship, 2);
    assert!(told.contains("regrind plant init"), "{told}");
    assert!(plant.does(&init).contains("it had 0"));
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn connection_errors_name_remedy() {
    let mut plant = Plant::new();
    plant.cell("cell-1", &[]);
    let ship = ["ship", "--once", "--plant", "cell-1.toml"];
    let file = std::fs::read_to_string(plant.path("cell-1.toml")).unwrap();
    let wrong = |change: (&str, &str), code: i32, pieces: &[&str]| {
        std::fs::write(plant.path("cell-1.toml"), file.replace(change.0, change.1)).unwrap();
        let (_, told) = plant.ends(&ship, code);
        assert!(pieces.iter().all(|piece| told.contains(piece)), "{change:?}: {told}");
    };
    wrong(("user = \"cell_1\"", "user = \"cell_9\""), 2, &["login", "\"cell_9\"", "[database]"]);
    wrong(("cell-1.password", "none.password"), 2, &["none.password", "cannot be read", "`password_file`"]);
    wrong(("user = ", "usher = "), 2, &["usher"]);
    wrong(("[database]", "[database]\nname = \"other\""), 2, &["login", "\"other\"", "[database]"]);
    let socket = format!("host = \"{}\"", plant.postgres.socket().display());
    wrong((&socket, "host = \"plant.example\""), 2, &["plant.example", "`certificates`"]);
    wrong((&socket, "host = \"/nowhere\""), 3, &["cannot be reached"]);
    std::fs::write(plant.path("cell-1.toml"), &file).unwrap();
    std::fs::set_permissions(plant.path("cell-1.password"), std::os::unix::fs::PermissionsExt::from_mode(0o644))
        .unwrap();
    let (_, told) = plant.ends(&ship, 2);
    assert!(told.contains("cell-1.password") && told.contains("chmod 600"), "{told}");
    std::fs::set_permissions(plant.path("cell-1.password"), std::os::unix::fs::PermissionsExt::from_mode(0o600))
        .unwrap();
    plant.does(&ship);
    plant.postgres.kill();
    let (_, told) = plant.ends(&ship, 3);
    assert!(told.contains("cannot be reached"), "{told}");
    plant.postgres.go_on();
    plant.does(&ship);
}
