#![allow(missing_docs)]
use regrind::geometry::{Point, Pose};
use regrind::registration::*;
use regrind::surface::*;
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, centre};
use regrind_sim::shape::{FreeForm, Shape};
use std::time::Instant;
fn main() {
    let shape = FreeForm::default();
    let scattered: Vec<Point> = (0..451_401)
        .map(|k| {
            let (u, v) = ((k as f64 + 0.5) * 0.754877666 % 1.0, (k as f64 * 0.569840290998).fract());
            Point::from(shape.point(102.0 * (u - 0.5), 62.0 * (v - 0.5)))
        })
        .collect();
    let form = FormError::new(5, 30.0, 6.657e-3, 102.0, 62.0);
    let place = Placement::new([0.05, 0.02, -0.03], [0.01, 0.02, 0.03]);
    let m: Vec<Point> = (0..126)
        .flat_map(|j| (0..226).map(move |i| (i, j)))
        .map(|(i, j)| {
            Point::from(place.apply(centre(
                &shape,
                &form,
                1.5,
                101.9 * (f64::from(i) / 225.0 - 0.5),
                61.9 * (f64::from(j) / 125.0 - 0.5),
            )))
        })
        .collect();
    for _ in 0..4 {
        let p = scattered.clone();
        let t = Instant::now();
        let n = Nominal::scattered(p, Projection::Auto).unwrap();
        let a = t.elapsed();
        let mut o = Options::new(1.5);
        o.start = Start::Pose(Pose::identity());
        let r = register(&n, &m, &o).unwrap();
        println!("nominal {a:?} all {:?} used {} rms {}", t.elapsed(), r.verdict.used, r.verdict.rms_mm);
    }
}
