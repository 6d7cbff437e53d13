#![allow(missing_docs)]
use regrind::geometry::{Point, Pose, recognise_grid};
use regrind::registration::*;
use regrind::surface::*;
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, centre};
use regrind_sim::shape::{FreeForm, Shape};
use std::time::Instant;
fn main() {
    let shape = FreeForm::default();
    let pts: Vec<Point> = shape.grid(102.0, 62.0, 901, 501).into_iter().map(Point::from).collect();
    let form = FormError::new(5, 30.0, 6.657e-3, 102.0, 62.0);
    let sets: Vec<Vec<Point>> = [(226, 126), (901, 501)]
        .iter()
        .map(|&(nx, ny)| {
            let place = Placement::new([0.05, 0.02, -0.03], [0.01, 0.02, 0.03]);
            (0..ny)
                .flat_map(|j| (0..nx).map(move |i| (i, j)))
                .map(|(i, j)| {
                    Point::from(place.apply(centre(
                        &shape,
                        &form,
                        1.5,
                        101.9 * (f64::from(i) / f64::from(nx - 1) - 0.5),
                        61.9 * (f64::from(j) / f64::from(ny - 1) - 0.5),
                    )))
                })
                .collect()
        })
        .collect();
    if let Some(mode) = std::env::args().nth(1) {
        let k: usize = mode.parse().unwrap();
        let reps: usize = std::env::args().nth(2).unwrap().parse().unwrap();
        let n = Nominal::from_points(pts.clone(), Projection::Auto).unwrap();
        let t = Instant::now();
        for _ in 0..reps {
            let mut o = Options::new(1.5);
            if k < 2 {
                o.start = Start::Pose(Pose::identity());
            }
            std::hint::black_box(register(&n, &sets[k % 2], &o).unwrap());
        }
        println!("{:?}", t.elapsed() / reps as u32);
        let t = Instant::now();
        for _ in 0..reps {
            if k < 4 {
                break;
            }
            std::hint::black_box(Nominal::from_points(pts.clone(), Projection::Auto).unwrap());
        }
        println!("nominal {:?}", t.elapsed() / reps as u32);
        return;
    }
    for _ in 0..3 {
        let p = pts.clone();
        let t = Instant::now();
        let o = recognise_grid(&p);
        println!("recognise {:?}", t.elapsed());
        let t = Instant::now();
        drop(o);
        let n = Nominal::from_points(p, Projection::Auto).unwrap();
        println!("nominal {:?}", t.elapsed());
        for m in &sets {
            let mut o = Options::new(1.5);
            o.start = Start::Pose(Pose::identity());
            let t = Instant::now();
            let r = register(&n, m, &o).unwrap();
            println!("register {} {:?} it {}", m.len(), t.elapsed(), r.trace.len());
            let s = OffsetSurface::new(&n, 1.5, Side::Normal).unwrap();
            let inv = r.cmm_from_model.inverse();
            let t = Instant::now();
            let mut places: Vec<Place> = m.iter().map(|p| s.foot(&inv.point(p), Place::UNKNOWN).place).collect();
            println!("  cold feet {:?}", t.elapsed() / m.len() as u32);
            let t = Instant::now();
            let mut sum = 0.0;
            for (p, q) in m.iter().zip(&mut places) {
                let f = s.foot(&inv.point(p), *q);
                *q = f.place;
                sum += f.distance_mm;
            }
            println!("  warm feet {:?} {sum}", t.elapsed() / m.len() as u32);
        }
    }
    let t = Instant::now();
    let n = Nominal::scattered(pts.clone(), Projection::Auto).unwrap();
    println!("scattered nominal {:?}", t.elapsed());
    let mut o = Options::new(1.5);
    o.start = Start::Pose(Pose::identity());
    let t = Instant::now();
    let r = register(&n, &sets[0], &o).unwrap();
    println!("register {:?} it {}", t.elapsed(), r.trace.len());
    let t = Instant::now();
    let r = register(&n, &sets[0], &o).unwrap();
    println!("register again {:?} it {} {:?}", t.elapsed(), r.trace.len(), r.verdict.rms_mm);
}
