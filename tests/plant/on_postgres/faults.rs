//! Faults of the database and of its certificates that a cell must tell from a network that is down.

use std::fs;

use regrind_plant::{DatabaseLink, DatabaseSettings, Replicator};

use super::forged::Forged;
use crate::Plant;
use crate::program::{Running, regrind};

const SHIP: [&str; 4] = ["ship", "--once", "--plant", "cell-1.toml"];

/// Returns the connection of a cell.
pub async fn link(plant: &Plant, cell: &str) -> DatabaseLink {
    let settings = DatabaseSettings {
        host: plant.postgres.socket().display().to_string(),
        port: 5432,
        name: "regrind".into(),
        user: cell.replace('-', "_"),
        password_file: Some(plant.path(&format!("{cell}.password"))),
        certificates: None,
    };
    DatabaseLink::open(&settings).await.unwrap()
}

pub fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap()
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn full_database_is_waited_for_and_named() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    Forged::named("run-1").write(&plant.path("runs/run-1"), 1);
    plant.sql(
        "CREATE FUNCTION full_disk() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN
        RAISE EXCEPTION 'could not extend file: No space left on device' USING ERRCODE = 'disk_full'; END $$;
        CREATE TRIGGER full_disk BEFORE INSERT ON record FOR EACH ROW EXECUTE FUNCTION full_disk()",
    );
    runtime().block_on(async {
        let failed = Replicator::new(plant.path("runs"), None).round(&link(&plant, "cell-1").await).await.unwrap_err();
        assert!(matches!(failed, regrind_plant::PlantError::DatabaseFull { .. }) && failed.may_pass(), "{failed}");
    });
    plant.ends(&SHIP, 3);
    let mut shipping = Running::new(regrind(&["ship", "--plant", "cell-1.toml", "--json"], plant.home.path()));
    shipping.until("that the plant knows of the run", |_| {
        (plant.postgres.log().matches("could not extend file").count() > 2).then_some(())
    });
    plant.sql("DROP TRIGGER full_disk ON record");
    let told = shipping.line("that the records are shipped", |line| line.contains("\"records\":3"));
    assert!(told.contains("\"runs\":1"), "{told}");
    shipping.interrupt();
    let (code, errors) = shipping.end();
    assert!(code == 0 && errors.contains("disk") && !errors.contains("network"), "{errors}");
    assert_eq!(errors.matches("ship: ").count(), 1, "told once: {errors}");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn wrong_certificates_end_the_command() {
    let mut plant = Plant::new();
    plant.cell("cell-1", &[]);
    Forged::named("run-1").write(&plant.path("runs/run-1"), 1);
    let certificate = |name: &str, until: i32| {
        let mut params = rcgen::CertificateParams::new(vec![name.to_owned()]).unwrap();
        params.not_before = rcgen::date_time_ymd(2019, 1, 1);
        params.not_after = rcgen::date_time_ymd(until, 1, 1);
        let key = rcgen::KeyPair::generate().unwrap();
        (params.self_signed(&key).unwrap().pem(), key.serialize_pem())
    };
    let [good, expired, other] =
        [certificate("localhost", 2090), certificate("localhost", 2020), certificate("plant.example", 2090)];
    let foreign = certificate("localhost", 2090);
    for (its, trusted, code) in [(&good, &good, 0), (&good, &foreign, 2), (&expired, &expired, 2), (&other, &other, 2)]
    {
        fs::write(plant.path("server.pem"), &its.0).unwrap();
        fs::write(plant.path("server.key"), &its.1).unwrap();
        fs::write(plant.path("trusted.pem"), &trusted.0).unwrap();
        let port = plant.postgres.go_on_by_tls(&plant.path("server.pem"), &plant.path("server.key"));
        let file = format!(
            "[plant]\ncell = \"cell-1\"\n\n[database]\nhost = \"localhost\"\nport = {port}\nuser = \"cell_1\"\npassword_file = \"cell-1.password\"\n\
            certificates = \"trusted.pem\"\n"
        );
        fs::write(plant.path("tls.toml"), file).unwrap();
        plant.ends(&["ship", "--once", "--plant", "tls.toml"], code);
        if code == 2 {
            // It does not try for ever.
            plant.ends(&["ship", "--plant", "tls.toml"], 2);
        }
    }
}
