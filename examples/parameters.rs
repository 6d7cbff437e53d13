//! Machine parameters in many worlds: how often their estimates are right within their uncertainty, and how much it
//! saves to compensate them.
//!
//! ```text
//! cargo run --release --example parameters [WORLDS [FIRST [RECIPE]]]
//! ```
//! The program runs WORLDS (200) worlds from seed FIRST (1) on, of RECIPE (freeform-mirror). Wheel, setting and part
//! have the errors that `tests/testcell/study/identifiability.rs` states. There are three registrations: free, with x, y
//! and z locked, and with the tilts locked. Every part is made twice from the same blank on the same machines: with
//! parameters, and by the map alone.

use rayon::prelude::*;
use regrind_testcell::study::identifiability::{Compared, ParameterResult, corrections};
use regrind_testcell::study::{After, Bench, Machine};

const PASSES: u16 = 4;

fn main() {
    let number = |k: usize, otherwise: u64| std::env::args().nth(k).map_or(otherwise, |n| n.parse().expect("a number"));
    let (worlds, first) = (number(1, 200), number(2, 1));
    let name = std::env::args().nth(3).unwrap_or_else(|| "freeform-mirror".to_owned());
    let held = |held: [usize; 3]| std::array::from_fn(|k| held.contains(&k));
    let [free, settings, tilts] = [[false; 6], held([0, 1, 2]), held([3, 4, 4])];
    for (what, held, machine) in [
        ("free", free, Machine::Good),
        ("x, y and z held", settings, Machine::Good),
        ("tilts held", tilts, Machine::Good),
        ("free, on the machine as shipped", free, Machine::AsShipped),
    ] {
        let bench = Bench::new(&name).held(held).on(machine);
        let seeds = (first..first + worlds).into_par_iter();
        let made: Vec<Compared> = seeds.map(|seed| bench.told_apart(seed, PASSES)).collect();
        println!("\n{name}, {what}, {worlds} worlds\n");
        tell_parameters(&made);
        tell_corrections(&made);
    }
}

fn tell_parameters(made: &[Compared]) {
    println!(
        "| parameter | within U | U | error over its sigma, rms | off by, rms | taken back | asked for |\n|---|---|---|---|---|---|---|"
    );
    for kind in made[0].parameters.iter().map(|told| told.kind) {
        let told: Vec<&ParameterResult> =
            made.iter().flat_map(|world| &world.parameters).filter(|told| told.kind == kind).collect();
        let count = |of: &dyn Fn(&ParameterResult) -> bool| told.iter().filter(|told| of(told)).count();
        let mean =
            |of: &dyn Fn(&ParameterResult) -> f64| told.iter().map(|told| of(told)).sum::<f64>() / told.len() as f64;
        println!(
            "| {} | {:.1} % | {:.1} {} | {:.2} | {:.1} | {} | {} |",
            kind.name(),
            100.0 * count(&|told| told.off.abs() <= 1.0) as f64 / told.len() as f64,
            mean(&|told| told.expanded),
            kind.unit(),
            2.0 * mean(&|told| told.off * told.off).sqrt(),
            mean(&|told| told.truth * told.truth).sqrt(),
            count(&|told| told.taken != 0.0),
            count(&|told| told.is_beyond),
        );
    }
}

fn tell_corrections(made: &[Compared]) {
    println!("\n| | pass 1 | pass 2 | pass 3 | pass 4 | corrections to the floor |\n|---|---|---|---|---|---|");
    type Way = fn(&Compared) -> &[After];
    let ways: [(&str, Way); 2] = [("with parameters", |world| &world.with), ("by the map alone", |world| &world.alone)];
    for (what, of) in ways {
        let sum = |pass: usize, f: fn(&After) -> f64| made.iter().map(|world| f(&of(world)[pass]).powi(2)).sum::<f64>();
        let ratio = |pass: usize| (sum(pass, |a| a.rms_um) / sum(pass, |a| a.floor_um)).sqrt();
        let ratios: String = (0..usize::from(PASSES)).map(|pass| format!(" {:.2} |", ratio(pass))).collect();
        let mean = made.iter().map(|world| corrections(of(world)) as f64).sum::<f64>() / made.len() as f64;
        println!("| {what} |{ratios} {mean:.2} |");
    }
    let count = |of: &dyn Fn(&Compared) -> bool| made.iter().filter(|world| of(world)).count();
    let both = |world: &Compared| [corrections(&world.with), corrections(&world.alone)];
    println!(
        "\nfewer corrections in {}, more in {}; after the first correction what comes back in every pass is less in {}, more by over a tenth in {}; the whole error is less in {}, more by over a tenth in {}",
        count(&|world| both(world)[0] < both(world)[1]),
        count(&|world| both(world)[0] > both(world)[1]),
        count(&|world| world.with[1].repeatable_um < world.alone[1].repeatable_um),
        count(&|world| world.with[1].repeatable_um > 1.1 * world.alone[1].repeatable_um),
        count(&|world| world.with[1].rms_um < world.alone[1].rms_um),
        count(&|world| world.with[1].rms_um > 1.1 * world.alone[1].rms_um),
    );
}
