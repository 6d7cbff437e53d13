//! Posterior of the error model at given places, as a reference for other programs: benches/peers/model.py.
//!
//! ```text
//! cargo run --release --example field FILE
//! ```
//! FILE is JSON: `places`, `deviations_mm`, `effects` (one row per point, possibly empty), `asked`, `sigma_mm`,
//! `range_mm`, `scatter_mm`. The output is JSON: means and standard uncertainties at the places in `asked`, the
//! effects, and the computing time in milliseconds.

use nalgebra::DMatrix;
use regrind::model::{DensePosterior, Field, Hyperparameters, Observations};
use serde_json::{Value, json};

fn main() {
    let path = std::env::args().nth(1).expect("a file");
    let told: Value = serde_json::from_slice(&std::fs::read(&path).expect("a file that can be read")).expect("JSON");
    let number = |key: &str| told[key].as_f64().expect("a number");
    let numbers = |value: &Value| -> Vec<f64> {
        value.as_array().expect("a list").iter().map(|v| v.as_f64().expect("a number")).collect()
    };
    let places = |key: &str| -> Vec<[f64; 2]> {
        told[key].as_array().expect("a list").iter().map(|at| numbers(at).try_into().expect("x and y")).collect()
    };
    let rows: Vec<Vec<f64>> = told["effects"].as_array().expect("a list").iter().map(numbers).collect();
    let columns = rows.first().map_or(0, Vec::len);
    let (seen, asked) = (places("places"), places("asked"));
    let effects = DMatrix::from_fn(seen.len(), columns, |r, c| rows[r][c]);
    let observed =
        Observations { fixed_effects: effects, ..Observations::without_effects(seen, numbers(&told["deviations_mm"])) };
    let field = Field::new(number("sigma_mm"), number("range_mm"));
    let hyperparameters = Hyperparameters { field, noise_sigma_mm: number("scatter_mm"), noise_autocorrelation: 0.0 };
    let began = std::time::Instant::now();
    let model = DensePosterior::fit(&observed, hyperparameters).expect("a model");
    let said = model.predict(&asked);
    let ms = 1e3 * began.elapsed().as_secs_f64();
    let of = |of: fn(&regrind::model::Prediction) -> f64| said.iter().map(of).collect::<Vec<f64>>();
    let found: Vec<f64> = model.estimated_effects().0.iter().copied().collect();
    println!("{}", json!({ "mean_mm": of(|p| p.mean_mm), "sigma_mm": of(|p| p.sigma_mm), "effects": found, "ms": ms }));
}
