//! Machine that does exactly what a command says, for tests of the protocol, and a pass for it.

use regrind::device::Pass;
use regrind_sim::body::{self, Kind, Payload, Payloads, Physics, Progress, Refusal};

/// Returns a pass for a small part.
pub fn pass() -> Pass {
    Pass {
        spark_out_passes: 1,
        wheel_radius_mm: 25.0,
        feed_mm_min: 300.0,
        track_spacing_mm: 0.2,
        level_mm: 0.1,
        depth_of_cut_mm: 0.02,
        x_mm: [-10.0, 9.0],
        y_mm: [-15.0, 14.0],
        part_identity: [7; 32],
    }
}

/// Measuring machine whose probe touches exactly the target, or a grinder that only reports its commands.
pub struct Toy {
    kind: Kind,
    payloads: Payloads,
    work: (u32, u16),
    done: u32,
    points_a_second: f64,
    moved_s: f64,
    /// True if the machine gives its points in counts of a nanometre.
    in_counts: bool,
    /// Maximum number of points that it reaches.
    max_points: u32,
}

impl Toy {
    /// Returns a machine that measures, or executes thousandths of its path, at this speed.
    pub fn new(kind: Kind, points_a_second: f64) -> Self {
        Self {
            kind,
            payloads: Payloads::default(),
            work: (0, 0),
            done: 0,
            points_a_second,
            moved_s: 0.0,
            in_counts: false,
            max_points: u32::MAX,
        }
    }

    /// Returns the same machine with its points in counts of a nanometre.
    pub fn in_counts(self) -> Self {
        Self { in_counts: true, ..self }
    }

    /// Returns the same machine, which stops after this number of points.
    pub fn up_to(self, most: u32) -> Self {
        Self { max_points: most, ..self }
    }

    fn total(&self) -> u32 {
        let plan = self.payloads.plan.as_ref();
        plan.map_or(1000, |plan| ((plan.bytes.len() - 64) / 56) as u32)
    }

    /// Returns the number of bytes of a point.
    fn size(&self) -> usize {
        if self.in_counts { 20 } else { 32 }
    }

    fn points(&self) -> Vec<u8> {
        let plan = self.payloads.plan.as_ref().map(|plan| &plan.bytes[..]).unwrap_or_default();
        let real = |at: usize| f64::from_be_bytes(plan[at..at + 8].try_into().unwrap());
        let radius_mm = real(8);
        let mut records = Vec::new();
        for at in (64..plan.len()).step_by(56) {
            records.extend(&plan[at..at + 4]);
            records.extend([0, 1, 0, 0]);
            for axis in 0..3 {
                let centre_mm = real(at + 8 + 8 * axis) + radius_mm * real(at + 32 + 8 * axis);
                match self.in_counts {
                    true => records.extend(((centre_mm * 1e6).round() as i32).to_be_bytes()),
                    false => records.extend(centre_mm.to_be_bytes()),
                }
            }
        }
        records
    }

    /// Returns the content of the outbox, with these records.
    fn job_result(&self, bytes: Vec<u8>) -> body::ResultData {
        let cmm = self.kind == Kind::Cmm;
        let (format, scale_mm) = if self.in_counts { (2, 1e-6) } else { (1, 1.0) };
        body::ResultData {
            kind: if cmm { 4 } else { 5 },
            format,
            records: if cmm { (bytes.len() / self.size()) as u32 } else { 1 },
            bytes,
            coordinates: u16::from(cmm),
            probe_radius_mm: if cmm { 2.0 } else { 0.0 },
            scale_mm,
            temperature_c: 20.5,
            duration_s: self.moved_s,
        }
    }

    fn record(&self, result: u16) -> Vec<u8> {
        let mut record = Vec::new();
        record.extend(self.work.0.to_be_bytes());
        record.extend(self.work.1.to_be_bytes());
        record.extend(result.to_be_bytes());
        for figure in [1234.5, 67.8, 0.02, 0.25, 0.5, 25.0, 0.0] {
            record.extend(f64::to_be_bytes(figure));
        }
        record
    }
}

impl Physics for Toy {
    fn kind(&self) -> Kind {
        self.kind
    }
    fn name(&self) -> String {
        "Toy 1".into()
    }
    fn check(&self, _: u16, payload: &Payload) -> Result<(), Refusal> {
        match payload.bytes.first_chunk() {
            Some([0, 1]) => Ok(()),
            _ => Err(Refusal { answer: 8, reason: "not format 1".into() }),
        }
    }
    fn prepare(&mut self, job: u32, cycle: u16, payloads: &Payloads) -> Result<Progress, Refusal> {
        (self.work, self.payloads, self.done, self.moved_s) = ((job, cycle), payloads.clone(), 0, 0.0);
        Ok(Progress { total: self.total(), ..Progress::default() })
    }
    fn begin(&mut self) {}
    fn advance(&mut self, seconds: f64) -> Progress {
        self.moved_s += seconds;
        let total = self.total();
        self.done = ((self.moved_s * self.points_a_second) as u32).min(total).min(self.max_points);
        Progress { done: self.done, total, finished: self.done == total, fault: 0 }
    }
    fn retract(&mut self) {}
    fn has_partial_result(&self) -> bool {
        self.kind == Kind::Cmm
    }
    fn partial_result(&self) -> Option<body::ResultData> {
        let bytes = self.points().into_iter().take(self.size() * self.done as usize).collect();
        (self.kind == Kind::Cmm).then(|| self.job_result(bytes))
    }
    fn end_job(&mut self, result: u16) -> body::ResultData {
        let cmm = self.kind == Kind::Cmm;
        let bytes = if cmm { self.points() } else { self.record(result) };
        self.job_result(bytes)
    }
    fn interlocks(&self) -> u16 {
        15
    }
    fn temperature_c(&self) -> f64 {
        20.25
    }
}
