//! Where is the part? Registers measured probe centres to the offset of the nominal surface.
//!
//! ```text
//!  start  ------->  correspond -> linearize -> solve  ------->  verdict
//!  (search,         (feet)        (A, b)       (ball)           (covariance, weak directions, outliers)
//!   or given)          ^                          |
//!                      +------ iterate -----------+
//! ```
//!
//! The method is section 2 of the paper: alternate between the feet of the points on the offset surface and a
//! ball-constrained least-squares step of the pose, until the objective no longer falls.
//!
//! Pure: no file, no clock, no randomness; the same input gives the same bits on any number of threads. Frames: measured
//! points are in the CMM frame {W}, the nominal surface in the model frame {M}. Units: millimetres and radians.

mod correspond;
mod iterate;
mod lateral;
mod linearize;
mod point_to_point;
mod radius;
mod robust;
mod solve;
mod start;
mod verdict;

use rayon::prelude::*;
use thiserror::Error;

use crate::geometry::{Point, Pose, Vector};
use crate::surface::{Distance, Lookup, Nominal, OffsetSurface, Side, SurfaceError};

use correspond::{Correspondence, ResidualModel, at_feet, middle_and_size};
pub use iterate::Iteration;
use iterate::{Descent, Problem};
pub use lateral::{LateralError, MapLimits, lateral_error, weak_for_compensation};
pub use point_to_point::{PointToPoint, register_point_to_point};
pub use robust::Loss;
use robust::{ScaledLoss, robust_sigma};
pub use verdict::{Verdict, WeakDirection};

/// What the measured points are taken for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// Probe centres, registered to the offset surface: the method of the paper.
    #[default]
    Offset,
    /// Contact points, registered to the nominal surface itself; the probe radius is not used (paper, fig. 12a).
    Contact,
    /// Probe centres, registered to the nominal surface with the radius subtracted from every distance, the facet looked up
    /// below the centre (Xiong and Li; paper, fig. 12b). Wrong by micrometres on curved parts; for comparison.
    SubtractRadius,
}

/// Where to begin.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Start {
    /// Nowhere in particular: several poses are tried, chosen by the shape of the surface.
    #[default]
    Search,
    /// At a pose `cmm_from_model`.
    Pose(Pose),
}

/// On which side of the nominal surface the probe centres lie.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ProbeSide {
    /// The side on which the measured points fit; the side of the normals where both fit alike.
    #[default]
    Auto,
    /// This side; refused if the points fit the other one much better.
    Known(Side),
}

/// How to register.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Radius of the probe in millimetres.
    pub probe_radius_mm: f64,
    /// What the measured points are taken for.
    pub method: Method,
    /// How the nominal surface runs between its points.
    pub distance: Distance,
    /// Where to begin.
    pub start: Start,
    /// On which side of the nominal surface the probe centres lie.
    pub side: ProbeSide,
    /// Coordinates that every step leaves alone: x, y, z, rx, ry, rz of the model frame.
    pub locked: [bool; 6],
    /// How a distance counts.
    pub loss: Loss,
    /// A point farther from the surface than this many robust sigmas, and from what its neighbours say, is an outlier;
    /// infinity keeps every point.
    pub outlier_sigmas: f64,
    /// Stop when 1 - f(l+1) / f(l) falls to this: the paper's epsilon.
    pub tolerance: f64,
    /// The first radius of the ball, in radians and in units of the cloud's rms size: alpha in eq. (15).
    pub ball_radius: f64,
    /// Give up after this many iterations.
    pub most_iterations: usize,
    /// Refuse a fit whose rms deviation is above this; `None` for 0.2 mm and one part in ten thousand of the cloud's rms size.
    pub rms_limit_mm: Option<f64>,
}

impl Options {
    /// Returns the defaults for a probe radius in millimetres.
    pub fn new(probe_radius_mm: f64) -> Self {
        Self {
            probe_radius_mm,
            method: Method::default(),
            distance: Distance::default(),
            start: Start::default(),
            side: ProbeSide::default(),
            locked: [false; 6],
            loss: Loss::default(),
            outlier_sigmas: 6.0,
            tolerance: 1e-9,
            ball_radius: 0.6,
            most_iterations: 100,
            rms_limit_mm: None,
        }
    }
}

/// What a registration found.
#[derive(Clone, Debug)]
pub struct Registration {
    /// Takes model coordinates to CMM coordinates: the paper's g.
    pub cmm_from_model: Pose,
    /// One for each measured point, in the order given.
    pub deviations: Vec<Deviation>,
    /// The trace of the iteration, steps taken back included.
    pub trace: Vec<Iteration>,
    /// The side on which the probe was.
    pub side: Side,
    /// How well the pose is known, and what to think of it.
    pub verdict: Verdict,
}

/// One measured point against the nominal surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Deviation {
    /// The contact point in the model frame: the centre moved back by the probe radius along the normal.
    pub point: Point,
    /// Unit normal of the nominal surface at the foot, towards the probe.
    pub normal: Vector,
    /// Signed distance in millimetres, positive where material stands proud.
    pub deviation_mm: f64,
    /// Standard uncertainty of the deviation in millimetres: the residual noise and the pose together.
    pub uncertainty_mm: f64,
    /// What became of the point.
    pub status: PointStatus,
}

/// What became of a measured point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PointStatus {
    /// It took part in the fit.
    Used,
    /// It is far from the surface and from its neighbours.
    Outlier,
    /// Its foot lies beyond the edge of the nominal surface.
    OffPart,
}

/// Why a registration cannot be had.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
pub enum RegistrationError {
    #[error(transparent)]
    Surface(#[from] SurfaceError),
    #[error(
        "the probe radius is {radius_mm} mm; it must be above 0 and below {limit_mm:.3} mm, half the size of the part"
    )]
    ProbeRadius { radius_mm: f64, limit_mm: f64 },
    #[error("there are {points} measured points and at least {least} are needed; measure more")]
    TooFewPoints { points: usize, least: usize },
    #[error("measured point {} is not finite; remove it or correct it", index + 1)]
    NotFinite { index: usize },
    #[error("all {points} measured points lie on one line; a pose needs points off it")]
    Collinear { points: usize },
    #[error(
        "{doubled} of {points} measured points that were looked at repeat another one exactly; was a file joined to itself? \
         remove the repeats"
    )]
    Repeated { doubled: usize, points: usize },
    #[error(
        "the measured cloud is {ratio:.4} times the size of the nominal surface ({measured_mm:.4} mm against {nominal_mm:.4} \
         mm); {remedy}"
    )]
    Size { ratio: f64, measured_mm: f64, nominal_mm: f64, remedy: &'static str },
    #[error(
        "only {used} of {points} measured points lie on the part; check that the cloud belongs to it, and the start pose"
    )]
    TooFewUsed { used: usize, points: usize },
    #[error(
        "no minimum within {iterations} iterations; the objective is at {objective_mm2:.3e} mm^2; allow more, or give a start pose"
    )]
    NotConverged { iterations: usize, objective_mm2: f64 },
    #[error(
        "the measured points do not fit the nominal surface: rms {rms_mm:.4} mm, limit {limit_mm:.4} mm; check part, units and \
         probe radius, or raise the limit"
    )]
    DoesNotFit { rms_mm: f64, limit_mm: f64 },
    #[error(
        "the measured cloud is a mirror image of the part: as measured it fits to {rms_mm:.4} mm, mirrored to \
         {mirrored_rms_mm:.4} mm rms; one axis of the CMM file is reversed"
    )]
    Mirrored { rms_mm: f64, mirrored_rms_mm: f64 },
    #[error(
        "the probe lies on the other side of the nominal surface: rms {other_rms_mm:.4} mm there, {rms_mm:.4} mm on the side \
         given; turn the normals or the side"
    )]
    WrongSide { rms_mm: f64, other_rms_mm: f64 },
    #[error("no direction of the pose is free or visible; unlock one, or give a surface with more shape")]
    Undetermined,
}

/// Registers measured points to a nominal surface.
///
/// Shapes: at least 7 measured points, in any order; the deviations come back in the same order. Frames: the points are in the
/// CMM frame, the surface in the model frame, and the pose takes the latter to the former. Units: millimetres. Equations: (3),
/// (7) to (15) of the paper.
///
/// # Errors
/// Input that cannot be registered, a cloud that does not fit the surface, and an iteration that does not converge.
pub fn register(nominal: &Nominal, measured: &[Point], options: &Options) -> Result<Registration, RegistrationError> {
    let part = Part::check(nominal, measured, options)?;
    if let ProbeSide::Known(side) = options.side {
        part.check_fold(options, side)?;
    }
    let initial = start::initial_pose(&part, measured, options)?;
    if options.side == ProbeSide::Auto {
        part.check_fold(options, initial.side)?;
    }
    let problem = part.problem(measured, options, initial.side);
    let mut trace = Vec::new();
    let mut correspondences: Vec<Correspondence> = measured.par_iter().map(|_| Correspondence::NEW).collect();
    let descent = trim_and_refit(&problem, &initial, options, &mut correspondences, &mut trace)?;
    let registration = report(&part, &problem, descent, correspondences, trace, &initial, options)?;
    part.confirm(&registration, measured, options)?;
    Ok(registration)
}

/// The nominal surface and the sizes that limits are stated in.
pub(crate) struct Part<'a> {
    nominal: &'a Nominal,
    /// Radius of the offset surface: the probe's, or 0 where the points are registered to the nominal surface itself.
    offset_mm: f64,
    /// Subtracted from each distance.
    subtract_mm: f64,
    /// Middle of the measured cloud.
    middle: Point,
    /// Rms size of the measured cloud.
    size_mm: f64,
    /// Singular values below this share of the largest count as unseen.
    least_share: f64,
}

impl<'a> Part<'a> {
    /// Checks what can be checked before anything is computed.
    fn check(nominal: &'a Nominal, measured: &[Point], options: &Options) -> Result<Self, RegistrationError> {
        const LEAST: usize = 7;
        if measured.len() < LEAST {
            return Err(RegistrationError::TooFewPoints { points: measured.len(), least: LEAST });
        }
        if let Some(index) = measured.par_iter().position_first(|p| !(p.x + p.y + p.z).is_finite()) {
            return Err(RegistrationError::NotFinite { index });
        }
        if crate::surface::is_line(measured) {
            return Err(RegistrationError::Collinear { points: measured.len() });
        }
        check_repeats(measured)?;
        if options.locked == [true; 6] {
            return Err(RegistrationError::Undetermined);
        }
        let (middle, size_mm) = middle_and_size(measured);
        let nominal_mm = nominal.size_mm();
        check_sizes(size_mm, nominal_mm)?;
        let radius_mm = options.probe_radius_mm;
        let limit_mm = 0.5 * nominal_mm;
        if options.method != Method::Contact && !(radius_mm > 0.0 && radius_mm < limit_mm) {
            return Err(RegistrationError::ProbeRadius { radius_mm, limit_mm });
        }
        let (offset_mm, subtract_mm) = match options.method {
            Method::Offset => (radius_mm, 0.0),
            Method::Contact => (0.0, 0.0),
            Method::SubtractRadius => (0.0, radius_mm),
        };
        let least_share = 1e-6_f64.max(3.0 * nominal.normal_error());
        Ok(Self { nominal, offset_mm, subtract_mm, middle, size_mm, least_share })
    }

    fn surface(&self, options: &Options, side: Side) -> OffsetSurface<'a> {
        let lookup = if options.method == Method::SubtractRadius { Lookup::Projection } else { Lookup::Foot };
        OffsetSurface::new(self.nominal, self.offset_mm, side)
            .expect("the radius was checked")
            .with_distance(options.distance)
            .with_lookup(lookup)
    }

    /// Refuses a probe that does not fit into the surface.
    fn check_fold(&self, options: &Options, side: Side) -> Result<(), RegistrationError> {
        match self.surface(options, side).fold() {
            Some(fold) => Err(fold.into()),
            None => Ok(()),
        }
    }

    fn problem<'b>(&self, measured: &'b [Point], options: &Options, side: Side) -> Problem<'b>
    where
        'a: 'b,
    {
        Problem {
            surface: self.surface(options, side),
            residual: ResidualModel { subtract_mm: self.subtract_mm, loss: ScaledLoss::new(Loss::None, 1.0) },
            measured,
            middle: self.middle,
            size_mm: self.size_mm,
            locked: options.locked,
            least_share: self.least_share,
            tolerance: options.tolerance,
            ball_radius: options.ball_radius,
            most_iterations: options.most_iterations,
        }
    }

    fn rms_limit_mm(&self, options: &Options) -> f64 {
        options.rms_limit_mm.unwrap_or(0.2 + 1e-4 * self.size_mm)
    }

    /// Refuses a fit that is none: a cloud of another part, or a mirror image.
    fn confirm(&self, found: &Registration, measured: &[Point], options: &Options) -> Result<(), RegistrationError> {
        let rms_mm = found.verdict.rms_mm;
        let limit_mm = self.rms_limit_mm(options);
        let doubtful = rms_mm > limit_mm || rms_mm > (0.02 * self.nominal.relief_mm()).max(10.0 * LEAST_SIGMA_MM);
        if doubtful
            && let Some(mirrored_rms_mm) = start::mirrored_rms(self, measured, options, found)
            && mirrored_rms_mm < 0.3 * rms_mm
            && mirrored_rms_mm <= limit_mm
        {
            return Err(RegistrationError::Mirrored { rms_mm, mirrored_rms_mm });
        }
        if rms_mm > limit_mm {
            return Err(RegistrationError::DoesNotFit { rms_mm, limit_mm });
        }
        Ok(())
    }
}

/// Refuses a cloud of which more than one point in a hundred is there twice.
///
/// Looked at are the points whose own bits choose them, some thousand of any number: of two equal points both or neither.
fn check_repeats(measured: &[Point]) -> Result<(), RegistrationError> {
    const LOOKED_AT: usize = 8192;
    let mixed = |p: &Point| {
        let [x, y, z] = [p.x, p.y, p.z].map(|c| (c + 0.0).to_bits());
        let mixed = x.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ y.rotate_left(21).wrapping_mul(0xD6E8_FEB8_6659_FD93) ^ z;
        let mixed = (mixed ^ (mixed >> 32)).wrapping_mul(0xD6E8_FEB8_6659_FD93);
        mixed ^ (mixed >> 29)
    };
    let one_in = measured.len().div_ceil(LOOKED_AT) as u64;
    let mixed = |(k, p): (usize, &Point)| (mixed(p), k);
    let mut chosen: Vec<(u64, usize)> =
        measured.par_iter().enumerate().with_min_len(4096).map(mixed).filter(|(h, _)| h % one_in == 0).collect();
    chosen.sort_unstable();
    let doubled = chosen.windows(2).filter(|w| w[0].0 == w[1].0 && measured[w[0].1] == measured[w[1].1]).count();
    if doubled * 100 > chosen.len() {
        return Err(RegistrationError::Repeated { doubled, points: chosen.len() });
    }
    Ok(())
}

fn check_sizes(measured_mm: f64, nominal_mm: f64) -> Result<(), RegistrationError> {
    let ratio = measured_mm / nominal_mm;
    let remedy = match ratio {
        r if !(r > 0.0 && r.is_finite()) => "a size must be above 0",
        r if r > 500.0 => {
            "are the nominal points in metres, or the measured ones in micrometres? give both in millimetres"
        }
        r if r > 15.0 => "are the nominal points in inches or centimetres? give both in millimetres",
        r if r > 3.0 => "is this the nominal surface of this part, and are both in millimetres?",
        r if r < 0.002 => "are the measured points in metres? give both in millimetres",
        r if r < 0.06 => {
            "are the measured points in inches or centimetres, or on a small part of the surface only? give both in millimetres"
        }
        _ => return Ok(()),
    };
    Err(RegistrationError::Size { ratio, measured_mm, nominal_mm, remedy })
}

/// Descends, drops what is off the part or an outlier, and descends again until nothing changes.
fn trim_and_refit(
    problem: &Problem,
    initial: &start::InitialPose,
    options: &Options,
    correspondences: &mut [Correspondence],
    trace: &mut Vec<Iteration>,
) -> Result<Descent, RegistrationError> {
    /// Rounds after which points are only dropped and no longer taken back, so that the sets cannot alternate for ever.
    const BOTH_WAYS: usize = 8;
    const MOST_ROUNDS: usize = 16;
    let mut problem = *problem;
    let mut pose = initial.cmm_from_model;
    if initial.near {
        problem.ball_radius = problem.ball_radius.min(0.05);
    }
    let counts: &[usize] =
        if problem.surface.fits_normals() { &COARSE_COUNTS_WHERE_NORMALS_COST } else { &COARSE_COUNTS };
    let enough = 2 * counts.iter().max().expect("there is a count");
    for few in counts.iter().filter(|_| problem.measured.len() >= enough) {
        pose = descend_coarsely(&problem, pose, *few, if initial.near { Some(options) } else { None }, trace)?;
    }
    prefetch(&problem, correspondences, &pose);
    let mut known = None;
    if initial.near {
        let sums = problem.feet(correspondences, &pose, &problem.scaling_at(&pose));
        let changed = screen(&problem, options, correspondences, true);
        known = (changed == 0 && options.loss == Loss::None).then_some(sums);
    }
    let mut round = 0;
    loop {
        rescale(&mut problem, options, correspondences, round > 0 || initial.near);
        let descent = problem.descend(pose, known.take(), correspondences, trace)?;
        if !descent.converged {
            let (iterations, objective_mm2) = (options.most_iterations, descent.objective_mm2);
            return Err(RegistrationError::NotConverged { iterations, objective_mm2 });
        }
        pose = descent.cmm_from_model;
        round += 1;
        let changed = screen(&problem, options, correspondences, round < BOTH_WAYS);
        let robust_settling = options.loss != Loss::None && round < 4;
        if (changed == 0 && !robust_settling) || round == MOST_ROUNDS {
            return finish(descent, correspondences.len());
        }
    }
}

/// How many points of a dense cloud descend before the rest: first a few for the long way, then more for the rest of it.
const COARSE_COUNTS: [usize; 2] = [1024, 16_384];

/// The same where every place touched costs a fit: fewer touch less, and the rest then touch only where they end.
const COARSE_COUNTS_WHERE_NORMALS_COST: [usize; 1] = [2048];

/// Starts the search for the feet near where they are, with the normals there fitted all at once.
fn prefetch(problem: &Problem, correspondences: &mut [Correspondence], pose: &Pose) {
    if !problem.surface.fits_normals() {
        return;
    }
    let model_from_cmm = pose.inverse();
    let points: Vec<Point> = problem.measured.par_iter().map(|p| model_from_cmm.point(p)).collect();
    for (correspondence, place) in correspondences.iter_mut().zip(problem.surface.prefetch(&points)) {
        correspondence.place = place;
    }
}

/// Descends with a few of many points, from where the rest have a step or two to go; its turns stand in the trace.
///
/// Near the end outliers are told among the few themselves; far from it they cannot be.
fn descend_coarsely(
    problem: &Problem,
    pose: Pose,
    count: usize,
    screened: Option<&Options>,
    trace: &mut Vec<Iteration>,
) -> Result<Pose, RegistrationError> {
    let few: Vec<Point> = start::spread(problem.measured, count).copied().collect();
    let mut correspondences = vec![Correspondence::NEW; few.len()];
    let (middle, size_mm) = middle_and_size(&few);
    let coarse = Problem { measured: &few, middle, size_mm, ..*problem };
    prefetch(&coarse, &mut correspondences, &pose);
    if let Some(options) = screened {
        coarse.feet(&mut correspondences, &pose, &coarse.scaling_at(&pose));
        screen(&coarse, options, &mut correspondences, true);
    }
    Ok(coarse.descend(pose, None, &mut correspondences, trace)?.cmm_from_model)
}

/// Refuses an end that hangs on too few points, or on none of the six directions.
fn finish(descent: Descent, points: usize) -> Result<Descent, RegistrationError> {
    if descent.sums.points * 2 < points {
        return Err(RegistrationError::TooFewUsed { used: descent.sums.points, points });
    }
    if descent.rank == 0 {
        return Err(RegistrationError::Undetermined);
    }
    Ok(descent)
}

/// Gives a robust loss the scale of the distances as they are now.
fn rescale(problem: &mut Problem, options: &Options, correspondences: &[Correspondence], known: bool) {
    // Before the first distances are known there is no scale, and every point counts by its square.
    if known && options.loss != Loss::None {
        problem.residual.loss = ScaledLoss::new(options.loss, sigma_of(correspondences).1);
    }
}

/// No CMM repeats better than this, and rounding in a file may be all the scatter there is.
const LEAST_SIGMA_MM: f64 = 1e-5;

fn sigma_of(correspondences: &[Correspondence]) -> (f64, f64) {
    // A sample tells the sigma of many points to a percent.
    let stride = correspondences.len().div_ceil(1 << 16);
    let on_part = correspondences.iter().step_by(stride).filter(|t| t.beyond_steps <= 0.5).map(|t| t.distance_mm);
    let (median, sigma) = robust_sigma(on_part);
    (median, sigma.max(LEAST_SIGMA_MM))
}

/// Decides which points take part; returns how many changed.
///
/// An outlier is far from the surface and from its neighbours: a smooth form error, however large, is neither noise nor a
/// mistake of the probe. Beyond four times the limit its neighbours are no longer asked.
fn screen(problem: &Problem, options: &Options, correspondences: &mut [Correspondence], both_ways: bool) -> usize {
    let (median, sigma) = sigma_of(correspondences);
    let limit = options.outlier_sigmas * sigma;
    let far = |t: &Correspondence| (t.distance_mm - median).abs() > limit;
    let suspects: Vec<usize> = (0..correspondences.len()).filter(|&k| far(&correspondences[k])).collect();
    let isolated = if suspects.is_empty() {
        Vec::new()
    } else {
        isolated(problem.measured, correspondences, &suspects, 0.5 * limit)
    };
    let mut outlier = vec![false; if suspects.is_empty() { 0 } else { correspondences.len() }];
    for (&k, isolated) in suspects.iter().zip(isolated) {
        outlier[k] = isolated || (correspondences[k].distance_mm - median).abs() > 4.0 * limit;
    }
    let mut changed = 0;
    for (k, correspondence) in correspondences.iter_mut().enumerate() {
        let fits = correspondence.beyond_steps <= 0.5 && !outlier.get(k).copied().unwrap_or(false);
        if fits != correspondence.used && (both_ways || !fits) {
            correspondence.used = fits;
            changed += 1;
        }
    }
    changed
}

/// For each suspect, whether its distance departs by more than a limit from the median of eight neighbours.
///
/// Neighbours nearer than half the mean spacing are twins, repeats of the same place that repeat its mistake; they are not
/// asked. A suspect with nothing but twins around it is isolated.
fn isolated(measured: &[Point], correspondences: &[Correspondence], suspects: &[usize], limit_mm: f64) -> Vec<bool> {
    const ASKED: usize = 8;
    const NEAREST: std::num::NonZero<usize> = std::num::NonZero::new(64).expect("not zero");
    let coordinates: Vec<[f64; 3]> = measured.iter().map(|p| (*p).into()).collect();
    let Ok(tree) = kiddo::ImmutableKdTree::<f64, 3>::new_from_slice(&coordinates) else {
        return vec![true; suspects.len()];
    };
    // Points spread over a square of rms size s stand s sqrt(6 / n) apart.
    let twin_mm = 0.5 * middle_and_size(measured).1 * (6.0 / measured.len() as f64).sqrt();
    let is_isolated = |&k: &usize| {
        let nearest = tree.query(&coordinates[k]).nearest_n::<kiddo::SquaredEuclidean<f64>>(NEAREST).execute();
        let mut around: Vec<f64> = nearest
            .iter()
            .filter(|n| n.distance > twin_mm * twin_mm)
            .take(ASKED)
            .map(|n| correspondences[n.item as usize].distance_mm)
            .collect();
        around.sort_unstable_by(f64::total_cmp);
        around.get(around.len() / 2).is_none_or(|median| (correspondences[k].distance_mm - median).abs() > limit_mm)
    };
    suspects.par_iter().map(is_isolated).collect()
}

/// Turns the end of the iteration into what is reported.
fn report(
    part: &Part,
    problem: &Problem,
    descent: Descent,
    correspondences: Vec<Correspondence>,
    trace: Vec<Iteration>,
    initial: &start::InitialPose,
    options: &Options,
) -> Result<Registration, RegistrationError> {
    if let Some(fold) = problem.surface.fold_where_touched(correspondences.iter().map(|t| t.place)) {
        return Err(fold.into());
    }
    let mut verdict = verdict::judge(problem, &descent, &correspondences, initial, trace.len());
    let reporter = verdict::Reporter::new(part, &descent.scaling, &verdict, options);
    let pose = &descent.cmm_from_model;
    let deviations = at_feet(&problem.surface, problem.measured, &correspondences, pose, &descent.scaling, &reporter);
    verdict.coverage = verdict::coverage(part.nominal, &deviations);
    Ok(Registration { cmm_from_model: descent.cmm_from_model, deviations, trace, side: initial.side, verdict })
}
