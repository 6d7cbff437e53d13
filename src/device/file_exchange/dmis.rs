//! Measuring plan as a DMIS program (ISO 22093).
//!
//! The program recalls a sensor by its name, which the machine has qualified; it defines none. `PRCOMP` says if the
//! machine subtracts the probe radius. `TEXT/OUTFIL` writes part, cycle and identity of the plan into the output, which
//! returns with the points. This identifies the plan of a result. Between two points the probe travels above the
//! highest target.

use std::fmt::Write as _;

use crate::payload::Plan;
use regrind_formats::result::Coordinates;

/// Data that identify a program.
pub(super) struct DmisHeader<'a> {
    pub(super) part: &'a str,
    pub(super) cycle: u16,
    /// Identity of the plan.
    pub(super) identity: &'a str,
    /// Name of the sensor at the machine.
    pub(super) sensor: &'a str,
    pub(super) coordinates: Coordinates,
}

/// Returns `text` if it can be written between the quotes of a DMIS program. It then has at most 60 characters, all of
/// them printable ASCII characters other than `'` and `$`. Returns `None` for any other text.
fn quotable(text: &str) -> Option<&str> {
    let is_plain = |c: char| matches!(c, ' '..='~') && c != '\'' && c != '$';
    (text.len() <= 60 && text.chars().all(is_plain)).then_some(text)
}

/// Returns the text of the DMIS program with which a CMM measures the targets of `plan`. `about` contains the part, the
/// cycle, the identity (SHA-256) of the plan, the name of the sensor, and the meaning of the measured coordinates
/// (probe centres or contact points).
pub(super) fn program(plan: &Plan, about: &DmisHeader<'_>) -> String {
    let (compensation, what) = match about.coordinates {
        Coordinates::Centres => ("OFF", "centres"),
        Coordinates::Contacts => ("ON", "contacts"),
    };
    let name = quotable(about.part).unwrap_or("part");
    let mut text = format!("DMISMN/'REGRIND {name} CYCLE {}',05.0\nFILNAM/'{name}'\n", about.cycle);
    let _ = write!(text, "UNITS/MM,ANGDEC\nV(ACTUAL)=VFORM/ACT\nDISPLY/STOR,DMIS,V(ACTUAL)\nD(MACHINE)=DATSET/MCS\n");
    if let Some(part) = quotable(about.part) {
        let _ = writeln!(text, "TEXT/OUTFIL,'part: {part}'");
    }
    let _ = writeln!(text, "TEXT/OUTFIL,'cycle: {}'", about.cycle);
    let _ = writeln!(text, "TEXT/OUTFIL,$\n'plan: {}'", about.identity);
    let _ = writeln!(text, "TEXT/OUTFIL,'coordinates: {what}'\nPRCOMP/{compensation}\nMODE/PROG,MAN");
    let sensor = about.sensor;
    let _ = writeln!(text, "RECALL/S({sensor})\nSNSLCT/S({sensor})");
    let Plan { approach_mm, search_mm, speed_mm_s, .. } = *plan;
    let _ = writeln!(text, "SNSET/APPRCH,{approach_mm}\nSNSET/SEARCH,{search_mm}\nSNSET/RETRCT,{approach_mm}");
    let highest_mm = plan.targets.iter().map(|target| target.point_mm[2]).fold(f64::NEG_INFINITY, f64::max);
    let over_mm = highest_mm + plan.safe_height_mm + plan.probe_radius_mm;
    let slow =
        plan.careful_start.map_or((0, speed_mm_s), |careful| (careful.target_count as usize, careful.speed_mm_s));
    for (k, target) in plan.targets.iter().enumerate() {
        let speed_mm_s = if k < slow.0 { slow.1 } else { speed_mm_s };
        if k == 0 || k == slow.0 {
            let _ = writeln!(text, "FEDRAT/MESVEL,MPM,{}", speed_mm_s * 60.0 / 1000.0);
        }
        let ([x, y, z], [i, j, l], index) = (target.point_mm, target.normal, target.index);
        let at = format!("{x:.6},{y:.6},{z:.6},$\n{i:.9},{j:.9},{l:.9}");
        let reach_mm = approach_mm + plan.probe_radius_mm;
        let (over_x, over_y) = (x + reach_mm * i, y + reach_mm * j);
        let _ = writeln!(text, "F(P{index})=FEAT/POINT,CART,{at}\nMEAS/POINT,F(P{index}),1");
        let _ = writeln!(text, "GOTO/{over_x:.6},{over_y:.6},{over_mm:.6}\nPTMEAS/CART,{at}");
        let _ = writeln!(text, "GOTO/{over_x:.6},{over_y:.6},{over_mm:.6}\nENDMES\nOUTPUT/FA(P{index})");
    }
    text + "ENDFIL\n"
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::payload::{CarefulStart, PlanTarget, TargetKind};
    use regrind_formats::result::{Content, parse_result};

    const PLAN: &str = "00112233445566778899aabbccddeeff00112233445566778899aabbccddeeff";

    fn plan() -> Plan {
        let (what, normal) = (TargetKind::Part, [0.6, 0.0, 0.8]);
        let target = |index, point_mm| PlanTarget { index, kind: what, point_mm, normal };
        Plan {
            targets: vec![target(7, [1.5, -2.25, 3.0]), target(9, [4.0, 5.0, 6.0])],
            probe_radius_mm: 1.5,
            approach_mm: 2.5,
            search_mm: 2.0,
            speed_mm_s: 5.0,
            safe_height_mm: 50.0,
            careful_start: Some(CarefulStart { target_count: 1, speed_mm_s: 1.0 }),
        }
    }

    #[test]
    fn dmis_program_identifies_its_output() {
        let about =
            DmisHeader { part: "SN-7", cycle: 2, identity: PLAN, sensor: "PROBE6", coordinates: Coordinates::Centres };
        let text = program(&plan(), &about);
        for statement in [
            "UNITS/MM,ANGDEC\n",
            "RECALL/S(PROBE6)\nSNSLCT/S(PROBE6)\nSNSET/APPRCH,2.5\nSNSET/SEARCH,2\nSNSET/RETRCT,2.5\n",
            "PRCOMP/OFF\n",
            "FEDRAT/MESVEL,MPM,0.06\nF(P7)=FEAT/POINT,CART,1.500000,-2.250000,3.000000,$\n0.600000000,0.000000000,0.800000000\n\
             MEAS/POINT,F(P7),1\nGOTO/3.900000,-2.250000,57.500000\nPTMEAS/CART,1.500000,-2.250000,3.000000,$\n",
            "OUTPUT/FA(P7)\nFEDRAT/MESVEL,MPM,0.3\nF(P9)=FEAT/POINT",
        ] {
            assert!(text.contains(statement), "{statement}\n---\n{text}");
        }
        assert!(text.ends_with("ENDMES\nOUTPUT/FA(P9)\nENDFIL\n") && text.lines().all(|line| line.len() <= 80));
        // The reader identifies the output by the lines that the program has written into it.
        let said: String = text.split_inclusive('\n').filter(|line| line.starts_with(['T', '\''])).collect();
        let output = format!("UNITS/MM,ANGDEC\n{said}FA(P7)=FEAT/POINT,CART,1.5,-2.25,4.5,0.6,0,0.8\nENDFIL\n");
        let read = parse_result(std::path::Path::new("x.res"), output.as_bytes(), &Content::default()).unwrap();
        assert_eq!(read.statements.part.as_deref(), Some("SN-7"));
        assert_eq!((read.statements.cycle, read.statements.plan.as_deref()), (Some(2), Some(PLAN)));
        assert_eq!((read.coordinates, read.indices), (Some(Coordinates::Centres), Some(vec![7])));
        // A name that would end its quotes is not written.
        let odd = program(&plan(), &DmisHeader { part: "SN'7", ..about });
        assert!(!odd.contains("SN'7") && !odd.contains("'part:"));
    }
}
