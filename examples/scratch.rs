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
    let pts: Vec<Point> = shape.grid(102.0, 62.0, 901, 501).into_iter().map(Point::from).collect();
    for _ in 0..3 {
        let p = pts.clone();
        let t = Instant::now();
        let n = Nominal::from_points(p, Projection::Auto).unwrap();
        println!("nominal {:?} {:?}", t.elapsed(), n.kind());
    }
    let nominal = Nominal::from_points(pts.clone(), Projection::Auto).unwrap();
    let surf = OffsetSurface::new(&nominal, 1.5, Side::Normal).unwrap();
    let _ = surf;
    // undersampled, error free
    let exact: Vec<[f64; 3]> = (0..126)
        .flat_map(|j| (0..226).map(move |i| (i, j)))
        .map(|(i, j)| {
            centre(
                &shape,
                &FormError::none(),
                1.5,
                102.0 * (f64::from(i) / 225.0 - 0.5),
                62.0 * (f64::from(j) / 125.0 - 0.5),
            )
        })
        .collect();
    let cases = [
        ([20., 0., 0.], [0., 0., 0.]),
        ([0., 10., 0.], [0., 0., 0.]),
        ([0., 0., 20.], [0., 0., 0.]),
        ([0., 0., 0.], [20., 0., 0.]),
        ([0., 0., 0.], [0., 20., 0.]),
        ([0., 0., 0.], [0., 0., 10.]),
        ([20., 10., 20.], [20., 20., 10.]),
        ([-20., -10., -20.], [-20., -20., -10.]),
    ];
    for (t, a) in cases {
        let place = Placement::new(t, a);
        let m: Vec<Point> = exact.iter().map(|p| Point::from(place.apply(*p))).collect();
        let mut o = Options::new(1.5);
        o.start = Start::Pose(Pose::identity());
        o.side = ProbeSide::Known(Side::Normal);
        o.outlier_sigmas = f64::INFINITY;
        let t0 = Instant::now();
        match register(&nominal, &m, &o) {
            Ok(r) => {
                println!(
                    "{t:?} {a:?} {:?} it {} pv {:.3e} nm rms {:.3e} nm",
                    t0.elapsed(),
                    r.verdict.iterations,
                    r.verdict.pv_mm * 1e6,
                    r.verdict.rms_mm * 1e6
                );
                println!(
                    "   {:?}",
                    r.trace
                        .iter()
                        .map(|i| format!(
                            "{:.1e}{} s{:.1e} b{:.1e}",
                            i.objective_mm2,
                            if i.taken { "" } else { "!" },
                            i.step,
                            i.ball_radius
                        ))
                        .collect::<Vec<_>>()
                );
            }
            Err(e) => println!("{t:?} {a:?} ERR {e}"),
        }
    }
    let form = FormError::new(5, 30.0, 6.657e-3, 102.0, 62.0);
    for (nx, ny) in [(226, 126), (901, 501)] {
        let real: Vec<[f64; 3]> = (0..ny)
            .flat_map(|j| (0..nx).map(move |i| (i, j)))
            .map(|(i, j)| {
                centre(
                    &shape,
                    &form,
                    1.5,
                    101.9 * (f64::from(i) / f64::from(nx - 1) - 0.5),
                    61.9 * (f64::from(j) / f64::from(ny - 1) - 0.5),
                )
            })
            .collect();
        for (t, a) in [([0.05, 0.02, -0.03], [0.01, 0.02, 0.03]), ([20., 10., 20.], [20., 20., 10.])] {
            let place = Placement::new(t, a);
            let m: Vec<Point> = real.iter().map(|p| Point::from(place.apply(*p))).collect();
            for start in [Start::Pose(Pose::identity()), Start::Search] {
                let mut o = Options::new(1.5);
                o.start = start;
                for _ in 0..2 {
                    let t0 = Instant::now();
                    let r = register(&nominal, &m, &o);
                    let e = t0.elapsed();
                    match r {
                        Ok(r) => println!(
                            "real {} {t:?} {:?} it {} pv {:.4} um rms {:.4} um used {} cov {:.3} weak {:?} alt {}",
                            m.len(),
                            e,
                            r.verdict.iterations,
                            r.verdict.pv_mm * 1e3,
                            r.verdict.rms_mm * 1e3,
                            r.verdict.used,
                            r.verdict.coverage,
                            r.verdict.weak_directions,
                            r.verdict.alternatives.len()
                        ),
                        Err(e) => println!("ERR {e}"),
                    }
                }
            }
        }
    }
}
