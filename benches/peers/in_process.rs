//! The clock for `compare.py`: the same files as the peers read, the time without reading them.
//!
//! Arguments: nominal file, measured file, probe radius in mm, `identity` or `search`, repeats. Prints one line of JSON
//! with the median times in seconds. Without arguments, as under a plain `cargo bench`, it does nothing.

use std::error::Error;
use std::time::{Duration, Instant};

use regrind::formats::{read_measured, read_points};
use regrind::geometry::Pose;
use regrind::registration::{RegistrationOptions, Start, register};
use regrind::surface::{Nominal, PlaneProjection};

fn main() -> Result<(), Box<dyn Error>> {
    // Cargo adds `--bench` to what was asked for.
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let [nominal, measured, radius, start, repeats] = &arguments[..] else {
        println!("in_process is run by benches/peers/compare.py");
        return Ok(());
    };
    let (points, measured) = (read_points(nominal)?, read_measured(measured)?);
    let start = if start == "search" { Start::Search } else { Start::Pose(Pose::identity()) };
    let options = RegistrationOptions { start, ..RegistrationOptions::new(radius.parse()?) };
    let mut times = Vec::new();
    let mut turns = 0;
    for _ in 0..repeats.parse::<usize>()?.max(1) {
        let points = points.clone();
        let begun = Instant::now();
        let nominal = Nominal::from_points(points, PlaneProjection::Auto)?;
        let prepared = begun.elapsed();
        let registration = register(&nominal, &measured, &options)?;
        times.push((begun.elapsed(), prepared));
        turns = registration.trace.len();
    }
    let total_s = median(times.iter().map(|t| t.0));
    let prepare_s = median(times.iter().map(|t| t.1));
    println!("{{\"total_s\": {total_s}, \"prepare_s\": {prepare_s}, \"iterations\": {turns}}}");
    Ok(())
}

fn median(times: impl Iterator<Item = Duration>) -> f64 {
    let mut sorted: Vec<Duration> = times.collect();
    sorted.sort_unstable();
    sorted[sorted.len() / 2].as_secs_f64()
}
