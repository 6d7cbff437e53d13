//! A study: its workers give the same results as runs by hand, even if one of them dies.

use serde_json::Value;

use crate::Plant;
use crate::program::{Running, regrind, run, small_recipe};

fn jobs(plant: &Plant) -> Vec<Value> {
    let told = plant.does(&["study", "show", "limits", "--json", "--plant", "planner.toml"]);
    told.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn study_runs_match_their_seeds() {
    let plant = Plant::new();
    plant.somebody("planner", "planner");
    ["farm-1", "farm-2"].iter().for_each(|name| plant.somebody(name, "worker"));
    let recipe = small_recipe(plant.home.path(), 1000.0).display().to_string();
    let begin = |vary: &str| {
        let arguments = [
            "study",
            "begin",
            &recipe,
            "--name",
            "limits",
            "--seeds",
            "7..8",
            "--vary",
            vary,
            "--vary",
            "cycle.max_cycles=3",
            "--plant",
            "planner.toml",
        ];
        run(&arguments, plant.home.path())
    };
    let (code, _, told) = begin("acceptance.rms_um=1.0,-1.0");
    assert!(code == 2 && told.contains("rms_um"), "{told}");
    let (code, told, errors) = begin("acceptance.rms_um=0.002,1.0");
    assert!(code == 0 && told.starts_with("limits: 4 jobs"), "{told}{errors}");
    let (code, _, told) = begin("acceptance.rms_um=1.0");
    assert!(code == 2 && told.contains("\"limits\" already exists"), "{told}");

    // One worker dies with a job, whose lease expires faster here.
    let mut dies = Running::new(regrind(&["study", "work", "--plant", "farm-1.toml"], plant.home.path()));
    dies.until("a job", |_| (plant.sql("SELECT count(*) FROM study_job WHERE state = 'leased'") == "1").then_some(()));
    let lease = "SELECT leased_until < now() + interval '61 seconds' FROM study_job WHERE state = 'leased'";
    assert_eq!(plant.sql(lease), "t", "the job of a worker that died is soon free again");
    dies.signal("KILL");
    dies.end();
    plant.sql("UPDATE study_job SET leased_until = now() - interval '1 second' WHERE state = 'leased'");
    let told = plant.does(&["study", "work", "--plant", "farm-2.toml", "--workers", "2"]);
    assert_eq!(told, "4 runs made\n");
    assert_eq!(plant.asked_by("farm-1", "SELECT finish_job(1, 1, 1, false, '{}')").unwrap(), "f", "its lease is over");
    assert!(
        plant.asked_by("farm-1", "SELECT * FROM study").is_err()
            && plant.asked_by("farm-1", "SELECT stop_study('limits')").is_err()
    );

    let jobs = jobs(&plant);
    let of = |seed: u64, rms_um: f64| {
        jobs.iter().find(|job| job["seed"] == seed && job["varied"]["acceptance.rms_um"] == rms_um).unwrap()
    };
    assert!(jobs.iter().all(|job| job["state"] == "done"), "{jobs:?}");
    for seed in [7, 8] {
        assert_eq!(of(seed, 1.0)["result"]["result"], "accepted");
        assert_eq!(of(seed, 0.002)["result"]["result"], "not accepted");
        // The same seed gives the same truth, and the measurement agrees with it within its uncertainty.
        let run = &of(seed, 1.0)["result"];
        let last = run["cycles"].as_array().unwrap().last().unwrap();
        let [is, seen, u] = [&run["truth"]["rms_um"], &last["rms_um"], &last["rms_u_um"]].map(|v| v.as_f64().unwrap());
        assert!((is - seen).abs() < 3.0 * u, "{is} {seen} {u}");
    }
    let by_hand = ["run", &recipe, "--seed", "7", "--json", "--truth", "truth.json"];
    plant.ends(&by_hand, 0);
    let truth: Value = serde_json::from_str(&std::fs::read_to_string(plant.path("truth.json")).unwrap()).unwrap();
    let summary = regrind::report::run_summary(&crate::only_run(&plant.path("runs")).0).unwrap();
    let first = |seed: u64| of(seed, 0.002)["result"]["cycles"][0]["pv_um"].as_f64().unwrap();
    assert_eq!(Some(first(7)), summary.cycles[0].figures.map(|[[pv, _], _]| pv));
    assert_ne!(first(7), first(8));
    assert!(truth["pv_um"].as_f64().unwrap() > 0.0);

    let told = plant.does(&["study", "show", "limits", "--plant", "planner.toml"]);
    let lines: Vec<&str> = told.lines().collect();
    assert!(
        lines.len() == 3 && lines[1].contains("0.0 % (0.0 to 65.8)") && lines[1].contains("acceptance.rms_um = 0.002"),
        "{told}"
    );
    assert!(lines[2].contains("100.0 % (34.2 to 100.0)") && lines[2].contains("0 of 2"), "{told}");
    assert!(plant.does(&["study", "stop", "limits", "--plant", "planner.toml"]).contains("no further jobs"));
    plant.ends(&["study", "stop", "limits", "--plant", "planner.toml"], 1);
    plant.ends(&["study", "show", "none", "--plant", "planner.toml"], 1);
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn failed_runs_are_failed_with_their_reason() {
    let plant = Plant::new();
    plant.somebody("planner", "planner");
    plant.somebody("farm-1", "worker");
    let recipe = plant.path("a-mirror-with-a-name-of-many-letters.toml");
    std::fs::rename(small_recipe(plant.home.path(), 1000.0), &recipe).unwrap();
    // The wheel is set too low, so the part ends below the nominal surface. In one run of the two there is no part.
    let told = plant.does(&[
        "study",
        "begin",
        recipe.to_str().unwrap(),
        "--name",
        "limits",
        "--seeds",
        "7..7",
        "--vary",
        "simulation.faults.no_part=false,true",
        "--vary",
        "simulation.grinder.setting_error_z_um=-40.0",
        "--plant",
        "planner.toml",
    ]);
    assert!(told.starts_with("limits: 2 jobs"), "{told}");
    plant.does(&["study", "work", "--plant", "farm-1.toml", "--workers", "2"]);
    let jobs = jobs(&plant);
    let [made, failed] = [&jobs[0], &jobs[1]];
    assert_eq!((made["state"].as_str(), failed["state"].as_str()), (Some("done"), Some("failed")), "{jobs:#?}");
    let last = made["result"]["cycles"].as_array().unwrap().last().unwrap();
    let [is, seen, u] = [&made["result"]["truth"]["rms_um"], &last["rms_um"], &last["rms_u_um"]].map(Value::as_f64);
    assert!((is.unwrap() - seen.unwrap()).abs() < 3.0 * u.unwrap(), "{jobs:#?}");
    assert!(failed["result"]["error"].as_str().unwrap().starts_with("the run was held: "), "{jobs:#?}");
    let told = plant.does(&["study", "show", "limits", "--plant", "planner.toml"]);
    let lines: Vec<&str> = told.lines().collect();
    assert!(lines.len() == 4 && lines[3].starts_with("failed: 1, such as seed 7: the run was held: "), "{told}");
}

/// A worker waits while the database restarts, keeps the result of its run, and renews the lease of its job.
#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn worker_survives_restart_of_database() {
    let mut plant = Plant::new();
    plant.somebody("planner", "planner");
    plant.somebody("farm-1", "worker");
    let recipe = small_recipe(plant.home.path(), 200.0).display().to_string();
    plant.does(&["study", "begin", &recipe, "--name", "limits", "--seeds", "7..7", "--plant", "planner.toml"]);
    // Its messages go to a file, so that they can be read while it runs.
    let program = regrind(&[], plant.home.path()).get_program().to_str().unwrap().to_owned();
    let mut command = std::process::Command::new("sh");
    command.args(["-c", &format!("exec '{program}' study work --plant farm-1.toml 2> told")]);
    let mut worker = Running::new({
        command.current_dir(plant.home.path());
        command
    });
    worker
        .until("a job", |_| (plant.sql("SELECT count(*) FROM study_job WHERE state = 'leased'") == "1").then_some(()));
    plant.postgres.kill();
    let told = || std::fs::read_to_string(plant.path("told")).unwrap_or_default();
    worker.until("the loss", |_| told().contains("tries again").then_some(()));
    plant.postgres.go_on();
    let (code, told) = worker.end();
    assert_eq!(code, 0, "{told}");
    // The job has the result of its only run.
    let given = "SELECT count(*), max(lease), count(result) FROM study_job WHERE state = 'done'";
    assert_eq!(plant.sql(given), "1|1|1");

    // Only the lease that holds is renewed.
    plant
        .sql("UPDATE study_job SET state = 'leased', worker = 'farm_1', lease = 5, leased_until = now() WHERE job = 1");
    let renew = |lease: i32| plant.asked_by("farm-1", &format!("SELECT renew_job(1, 1, {lease}, 60)")).unwrap();
    assert_eq!((renew(4), renew(5)), ("f".into(), "t".into()));
    assert_eq!(plant.sql("SELECT leased_until > now() + interval '50 seconds' FROM study_job WHERE job = 1"), "t");
}
