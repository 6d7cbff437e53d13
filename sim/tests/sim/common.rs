//! A client in a few lines: payloads, whole jobs, and what is left of a deviation when the part may be moved.
#![allow(dead_code)]

use regrind_sim::aperture::Aperture;
use regrind_sim::body::{Payload, Payloads, Physics, ResultData};
use regrind_sim::grinder::Grinder;
use regrind_sim::part::{PartSpec, ShapeSpec};
use regrind_sim::payload::{Feature, Map, Pass, PassRecord, Plan, PointRecord, Target};
use regrind_sim::spec::WorldSpec;
use regrind_sim::world::World;
use regrind_testsim::payloads::{Encode, decode_pass_record, decode_points};
use regrind_testsim::perfect::{perfect_cmm, perfect_grinder};

/// Identity of the part of these tests.
pub const NOMINAL: [u8; 32] = [7; 32];

/// A small part on which a pass takes no time, ground and measured without error.
pub fn small_perfect() -> WorldSpec {
    WorldSpec {
        part: PartSpec {
            shape: ShapeSpec::Sphere { radius_mm: 60.0 },
            aperture: Aperture::rectangle(15.0, 10.0),
            form_error_um: 0.0,
            ..PartSpec::default()
        },
        grinder: perfect_grinder(),
        cmm: perfect_cmm(),
        ..WorldSpec::default()
    }
}

/// A finishing pass over a part of the given half sizes.
pub fn pass(half_mm: [f64; 2], level_mm: f64) -> Pass {
    Pass {
        spark_out: 1,
        wheel_radius_mm: 40.0,
        feed_mm_min: 1500.0,
        track_spacing_mm: 1.0,
        level_mm,
        depth_of_cut_mm: 0.02,
        extent_mm: [-half_mm[0], half_mm[0], -half_mm[1], half_mm[1]],
        nominal: NOMINAL,
    }
}

/// A map on a net about the origin.
pub fn map_of(half_mm: [f64; 2], spacing_mm: f64, value_mm: impl Fn(f64, f64) -> f64) -> Map {
    let [columns, rows] = half_mm.map(|half| (2.0 * half / spacing_mm).round() as u32 + 1);
    let place = |k: u32, half: f64| f64::from(k) * spacing_mm - half;
    let values_mm = (0..rows)
        .flat_map(|j| (0..columns).map(move |i| (i, j)))
        .map(|(i, j)| value_mm(place(i, half_mm[0]), place(j, half_mm[1])))
        .collect();
    let first_mm = half_mm.map(|half| -half);
    Map { columns, rows, first_mm, spacing_mm: [spacing_mm; 2], nominal: NOMINAL, values_mm }
}

pub fn zero_map(half_mm: [f64; 2]) -> Map {
    map_of(half_mm, half_mm[0], |_, _| 0.0)
}

pub fn grinder_payloads(map: &Map, pass: &Pass) -> Payloads {
    let payload = |bytes: Vec<u8>, kind: u8| Some(Payload { bytes, identity: [kind; 32] });
    Payloads { plan: None, map: payload(map.encode(), 2), pass: payload(pass.encode(), 3) }
}

pub fn cmm_payloads(plan: &Plan) -> Payloads {
    Payloads { plan: Some(Payload { bytes: plan.encode(), identity: [1; 32] }), ..Payloads::default() }
}

/// Goes on in steps until the machine has finished; panics on a fault.
pub fn run(machine: &mut impl Physics, step_s: f64) {
    while !{
        let progress = machine.advance(step_s);
        assert_eq!(progress.fault, 0);
        progress.finished
    } {}
}

/// A whole pass.
pub fn grind(grinder: &mut Grinder, job: u32, cycle: u16, map: &Map, pass: &Pass) -> PassRecord {
    grinder.prepare(job, cycle, &grinder_payloads(map, pass)).unwrap();
    grinder.begin();
    run(grinder, 7.0);
    decode_pass_record(&grinder.end_job(1).bytes).unwrap()
}

/// A plan for places over the nominal surface of a world, touched along the normals.
pub fn plan(world: &World, places_mm: &[[f64; 2]]) -> Plan {
    let target = |(index, [x, y]): (usize, &[f64; 2])| {
        let (point_mm, normal) = world.nominal(*x, *y);
        Target { index: index as u32, feature: Feature::Part, point_mm, normal }
    };
    Plan {
        probe_radius_mm: 1.5,
        approach_mm: 4.0,
        search_mm: 4.0,
        speed_mm_s: 3.0,
        safe_height_mm: 20.0,
        careful: (0, 0.0),
        targets: places_mm.iter().enumerate().map(target).collect(),
    }
}

/// A whole measurement.
pub fn measure(cmm: &mut impl Physics, plan: &Plan) -> (ResultData, Vec<PointRecord>) {
    cmm.prepare(1, 0, &cmm_payloads(plan)).unwrap();
    cmm.begin();
    run(cmm, 100.0);
    let outcome = cmm.end_job(1);
    let records = decode_points(&outcome.bytes, (outcome.format == 2).then_some(outcome.scale_mm)).unwrap();
    (outcome, records)
}

/// Places on a net about the origin.
pub fn net(half_mm: [f64; 2], spacing_mm: f64) -> Vec<[f64; 2]> {
    let steps = half_mm.map(|half| (2.0 * half / spacing_mm).floor() as i32);
    let place = |k: i32, steps: i32| (f64::from(k) - f64::from(steps) / 2.0) * spacing_mm;
    (0..=steps[1]).flat_map(|j| (0..=steps[0]).map(move |i| [place(i, steps[0]), place(j, steps[1])])).collect()
}

/// Takes out of deviations what moving the part would: the six rigid motions, by least squares.
pub fn best_fit(world: &World, places_mm: &[[f64; 2]], deviations_mm: &[f64]) -> Vec<f64> {
    let rows: Vec<[f64; 6]> = places_mm
        .iter()
        .map(|&[x, y]| {
            let (p, n) = world.nominal(x, y);
            let turn = [p[1] * n[2] - p[2] * n[1], p[2] * n[0] - p[0] * n[2], p[0] * n[1] - p[1] * n[0]];
            [n[0], n[1], n[2], turn[0] / 50.0, turn[1] / 50.0, turn[2] / 50.0]
        })
        .collect();
    let mut normal = [[0.0; 7]; 6];
    for (row, d) in rows.iter().zip(deviations_mm) {
        for i in 0..6 {
            for j in 0..6 {
                normal[i][j] += row[i] * row[j];
            }
            normal[i][6] += row[i] * d;
        }
    }
    let motion = eliminate(normal);
    rows.iter().zip(deviations_mm).map(|(row, d)| d - (0..6).map(|i| row[i] * motion[i]).sum::<f64>()).collect()
}

/// Gauss and Jordan on a symmetric system; a motion that the surface does not see stays 0.
fn eliminate(mut a: [[f64; 7]; 6]) -> [f64; 6] {
    let scale = (0..6).map(|i| a[i][i]).fold(0.0, f64::max);
    let mut solution = [0.0; 6];
    for k in 0..6 {
        if a[k][k] < 1e-12 * scale {
            a[k] = [0.0; 7];
            a[k][k] = 1.0;
        }
        let pivot = a[k][k];
        a[k].iter_mut().for_each(|value| *value /= pivot);
        let row = a[k];
        for (i, other) in a.iter_mut().enumerate().filter(|(i, _)| *i != k) {
            let factor = other[k];
            other.iter_mut().zip(row).for_each(|(value, r)| *value -= factor * r);
            let _ = i;
        }
    }
    for (k, value) in solution.iter_mut().enumerate() {
        *value = a[k][6];
    }
    solution
}

/// Returns the true deviation of the real surface from the nominal surface, averaged over the part, in mm. The ridges
/// between the grinder's tracks are included.
pub fn level_mm(world: &World) -> f64 {
    world.with_part(|part| {
        let nodes: Vec<[f64; 2]> = part.height.nodes().filter(|[x, y]| part.aperture.contains(*x, *y)).collect();
        // The mean of a parabola is a third of its height.
        let heights = nodes.iter().map(|&[x, y]| part.height.at(x, y).0 + part.ridge_mm(x, y) / 3.0);
        heights.sum::<f64>() / nodes.len() as f64
    })
}

/// Peak to valley and root of the mean square, in micrometres.
pub fn pv_rms_um(deviations_mm: &[f64]) -> (f64, f64) {
    let (low, high) =
        deviations_mm.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), d| (d.min(low), d.max(high)));
    let square = deviations_mm.iter().map(|d| d * d).sum::<f64>() / deviations_mm.len() as f64;
    (1e3 * (high - low), 1e3 * square.sqrt())
}
