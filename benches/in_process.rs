//! Clock of a registration in process, for the comparison with the same call from Python.
//!
//! Arguments: nominal file, measured file, probe radius in mm. Registers once for each line on standard input, from the
//! identity, and prints the times in seconds: of the nominal surface, and of the registration. Without arguments, as
//! under a plain `cargo bench`, it does nothing.

use std::error::Error;
use std::io::{Write, stdin, stdout};
use std::time::Instant;

use regrind::formats::{read_measured, read_points};
use regrind::geometry::Pose;
use regrind::registration::{RegistrationOptions, Start, register};
use regrind::surface::{Nominal, PlaneProjection};

fn main() -> Result<(), Box<dyn Error>> {
    // Cargo adds `--bench` to what was asked for.
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let [nominal, measured, radius] = &arguments[..] else {
        println!("in_process is run by src/python/tests/time_of_call.py");
        return Ok(());
    };
    let (points, measured) = (read_points(nominal)?, read_measured(measured)?);
    let options =
        RegistrationOptions { start: Start::Pose(Pose::identity()), ..RegistrationOptions::new(radius.parse()?) };
    for line in stdin().lines() {
        line?;
        let points = points.clone();
        let begun = Instant::now();
        let nominal = Nominal::from_points(points, PlaneProjection::Auto)?;
        let prepared = begun.elapsed();
        // The other process has had the caches. The second call finds its own data there.
        std::hint::black_box(register(&nominal, &measured, &options)?);
        let begun = Instant::now();
        let registration = register(&nominal, &measured, &options)?;
        let registered = begun.elapsed();
        std::hint::black_box(registration);
        println!("{} {}", prepared.as_secs_f64(), registered.as_secs_f64());
        stdout().flush()?;
    }
    Ok(())
}
