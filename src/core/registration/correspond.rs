//! First of the two alternating problems: projects each point onto the offset surface under a given pose.

use rayon::prelude::*;

use crate::geometry::{Point, Pose, Vector};
use crate::surface::simd::{F64x4, LANES, Real, Vector3x4};
use crate::surface::{FacetIndex, OffsetSurface, PointProjection, ProjectionX4, points_x4};

use super::deviation::PointStatus;
use super::linearize::{FourSums, Scaling, Sums};
use super::robust_loss::ScaledLoss;

/// Points per task: enough to hide the cost of a task, few enough to share the work between threads.
const CHUNK: usize = 512;

/// Conversion of a probe centre to a distance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ResidualModel {
    /// Length subtracted from every distance: the probe radius if the surface is not offset by it.
    pub(crate) subtract_mm: f64,
    /// Loss that weights a distance.
    pub(crate) loss: ScaledLoss,
}

/// Tolerance for rounding, in steps of the sampling: a projection no farther than this beyond the edge is on the part.
pub(super) const EDGE_TOLERANCE_STEPS: f32 = 1e-3;

/// State of a measured point that passes from one iteration to the next.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Correspondence {
    pub(crate) facet: FacetIndex,
    pub(crate) distance_mm: f64,
    /// Distance of the projection beyond the edge, in steps of the sampling.
    pub(crate) beyond_steps: f32,
    /// True if the point takes part in the fit.
    pub(crate) in_fit: bool,
}

impl Correspondence {
    /// Returns `Inlier` if the point is in the fit. Otherwise returns `OffPart` if its projection is beyond the edge of
    /// the nominal surface, else `Outlier`.
    pub(crate) fn status(&self) -> PointStatus {
        match self.in_fit {
            true => PointStatus::Inlier,
            false if self.is_off_part() => PointStatus::OffPart,
            false => PointStatus::Outlier,
        }
    }

    /// Returns true if the projection of the point lies beyond the edge of the nominal surface by more than rounding.
    /// Such a point cannot be compared with the surface, even if it is near the edge.
    pub(crate) fn is_off_part(&self) -> bool {
        self.beyond_steps > EDGE_TOLERANCE_STEPS
    }

    pub(crate) const INITIAL: Self =
        Self { facet: FacetIndex::UNKNOWN, distance_mm: 0.0, beyond_steps: 0.0, in_fit: true };
}

/// Projects all `measured` points onto the surface under the pose `cmm_from_model`. Returns the normal equations of the
/// next least-squares step of the pose (see [`Sums`]).
///
/// Updates the facet, the distance and the distance beyond the edge in each entry of `correspondences`, which has one
/// entry for each point. Only points whose entry has `in_fit` set contribute to the normal equations. `residual`
/// converts a distance to a weight, and `scaling` defines the coordinates of the step.
///
/// Several threads process the points in chunks. The results of the chunks are added in order. So the result depends
/// neither on the number of threads nor on the vector instructions of the processor.
pub(crate) fn correspond(
    surface: &OffsetSurface,
    residual: &ResidualModel,
    measured: &[Point],
    correspondences: &mut [Correspondence],
    cmm_from_model: &Pose,
    scaling: &Scaling,
) -> Sums {
    let pass = ProjectionPass { surface, residual, model_from_cmm: cmm_from_model.inverse(), scaling };
    let arch = pulp::Arch::new();
    let task = |(points, correspondences)| arch.dispatch(Chunk { projection_pass: &pass, points, correspondences });
    if measured.len() <= 2 * CHUNK {
        return task((measured, correspondences));
    }
    let parts: Vec<Sums> = measured.par_chunks(CHUNK).zip(correspondences.par_chunks_mut(CHUNK)).map(task).collect();
    parts.iter().fold(Sums::zero(), Sums::merge)
}

/// Work of one task, in a form that is compiled once for each set of vector instructions.
struct Chunk<'a> {
    projection_pass: &'a ProjectionPass<'a>,
    points: &'a [Point],
    correspondences: &'a mut [Correspondence],
}

impl pulp::NullaryFnOnce for Chunk<'_> {
    type Output = Sums;

    // Inlined into the caller that uses the vector instructions: a called function would be compiled without them.
    /// Projects the points of this chunk onto the surface, and returns their contribution to the normal equations of
    /// the pose.
    #[inline(always)]
    fn call(self) -> Sums {
        self.projection_pass.sum_chunk(self.points, self.correspondences)
    }
}

/// One pass over the points: the data that all of them share.
struct ProjectionPass<'a> {
    surface: &'a OffsetSurface<'a>,
    residual: &'a ResidualModel,
    model_from_cmm: Pose,
    scaling: &'a Scaling,
}

impl ProjectionPass<'_> {
    /// Projects one chunk of `points` onto the surface, updates their `correspondences`, and returns the contribution
    /// of the chunk to the normal equations of the pose. Four points are projected together if the surface supports
    /// this. If one of the four is beyond the edge or too far from its start facet, they are projected one by one.
    #[inline(always)]
    fn sum_chunk(&self, points: &[Point], correspondences: &mut [Correspondence]) -> Sums {
        let mut sums = Sums::zero();
        let mut fours = FourSums::zero();
        let mut last = FacetIndex::UNKNOWN;
        let mut recent = [[FacetIndex::UNKNOWN; LANES]; 2];
        let in_fours = self.surface.supports_project_x4() && self.surface.nominal().outline().is_none();
        let (four_points, rest_points) = points.as_chunks::<LANES>();
        let (four_correspondences, rest_correspondences) = correspondences.as_chunks_mut::<LANES>();
        for (points, correspondences) in four_points.iter().zip(four_correspondences) {
            // No closure around code that needs the vector instructions: a closure would be compiled without them.
            let start = if in_fours { self.start(correspondences, &recent) } else { None };
            let taken = match start {
                Some(places) => self.project_x4(points, correspondences, places, &mut fours),
                None => false,
            };
            if !taken {
                for (point, correspondence) in points.iter().zip(&mut *correspondences) {
                    self.project_one(point, correspondence, &mut last, &mut sums);
                }
            }
            recent = [
                recent[1],
                [
                    correspondences[0].facet,
                    correspondences[1].facet,
                    correspondences[2].facet,
                    correspondences[3].facet,
                ],
            ];
            last = correspondences[LANES - 1].facet;
        }
        for (point, correspondence) in rest_points.iter().zip(rest_correspondences) {
            self.project_one(point, correspondence, &mut last, &mut sums);
        }
        fours.add_to(&mut sums);
        sums
    }

    /// Returns the facets at which the projection of four points starts. These are the facets in `correspondences`,
    /// from the last projections of the four points.
    ///
    /// If one of these facets is unknown, all four are extrapolated from `recent`: the facets of the eight preceding
    /// points. Returns `None` if the extrapolation is not possible. This is so on a mesh, or if a facet of the four
    /// directly preceding points is unknown ([`OffsetSurface::extrapolate_x4`]).
    #[inline(always)]
    fn start(
        &self,
        correspondences: &[Correspondence; LANES],
        recent: &[[FacetIndex; LANES]; 2],
    ) -> Option<[FacetIndex; LANES]> {
        let places =
            [correspondences[0].facet, correspondences[1].facet, correspondences[2].facet, correspondences[3].facet];
        if !places.contains(&FacetIndex::UNKNOWN) {
            return Some(places);
        }
        self.surface.extrapolate_x4(&recent[0], &recent[1])
    }

    /// Projects four measured points together onto the surface. `places` has the start facet of the search for each
    /// point. Updates the facet, the distance and the distance beyond the edge in the four `correspondences`. Adds the
    /// points that are in the fit to `sums`.
    ///
    /// Returns true if all four points were projected. Returns false and changes nothing if one of the points is beyond
    /// the edge or too far from its start facet.
    #[inline(always)]
    fn project_x4(
        &self,
        points: &[Point; LANES],
        correspondences: &mut [Correspondence; LANES],
        mut places: [FacetIndex; LANES],
        sums: &mut FourSums,
    ) -> bool {
        let p = transform_x4(&self.model_from_cmm, &points_x4(points));
        let Some(feet) = self.surface.project_x4(&p, &mut places) else { return false };
        let distance = feet.distance_mm - F64x4::splat(self.residual.subtract_mm);
        let (mut weight, mut loss, mut used) = ([0.0; LANES], [0.0; LANES], 0);
        for l in 0..LANES {
            correspondences[l].facet = places[l];
            correspondences[l].distance_mm = distance.0[l];
            correspondences[l].beyond_steps = 0.0;
            if correspondences[l].in_fit {
                (weight[l], loss[l]) = self.residual.loss.weigh(distance.0[l]);
                used += 1;
            }
        }
        sums.add(&self.scaling.four_rows(&p, &feet.normal), distance, F64x4(weight), F64x4(loss), used);
        true
    }

    /// Projects one point onto the surface, and updates its `correspondence`. Adds the point to `sums` if it is in the
    /// fit. The search starts at the facet of the last projection of this point. If this facet is unknown, the search
    /// starts at the facet `last`. At the end `last` is set to the facet of the new projection.
    #[inline]
    fn project_one(&self, point: &Point, correspondence: &mut Correspondence, last: &mut FacetIndex, sums: &mut Sums) {
        let p = self.model_from_cmm.transform_point(point); // g^-1 Y
        // A point without an earlier place starts at the place of the point before it in the file, if there is one.
        let start = if correspondence.facet == FacetIndex::UNKNOWN { *last } else { correspondence.facet };
        let foot = self.surface.project(&p, start);
        *last = foot.facet;
        correspondence.facet = foot.facet;
        correspondence.distance_mm = foot.distance_mm - self.residual.subtract_mm;
        correspondence.beyond_steps = beyond_steps(self.surface, &p, &foot);
        if correspondence.in_fit {
            let (weight, loss) = self.residual.loss.weigh(correspondence.distance_mm);
            sums.add(&self.scaling.row(&p, &foot.normal), correspondence.distance_mm, weight, loss);
        }
    }
}

/// Returns the distance of a projection beyond the edge of the surface, in steps of the nominal sampling. Returns 0 if
/// the projection is on the part. `p` is the centre of the ball of the probe, in the model frame. `foot` is the
/// projection of `p` onto the surface.
///
/// Returns at least 1 if the contact point (where the ball touches the part) lies outside the outline of the part. The
/// reason: the nominal points can extend beyond the outline.
pub(super) fn beyond_steps(surface: &OffsetSurface, p: &Point, foot: &PointProjection) -> f32 {
    let is_outside = surface.nominal().outline().is_some_and(|outline| {
        let contact = p - foot.normal * (foot.distance_mm + surface.radius_mm());
        !outline.contains(contact.x, contact.y)
    });
    let steps = foot.beyond_edge_steps as f32;
    if is_outside { steps.max(1.0) } else { steps }
}

/// Applies a pose to the four points `w`. Each of the four lanes (elements of a vector register) holds one point.
#[inline(always)]
fn transform_x4(pose: &Pose, w: &Vector3x4) -> Vector3x4 {
    let (r, t) = (&pose.rotation, &pose.translation_mm);
    let row = |k: usize| {
        let part = |c: usize| F64x4::splat(r[(k, c)]) * w[c];
        part(0) + part(1) + part(2) + F64x4::splat(t[k])
    };
    [row(0), row(1), row(2)]
}

/// Four measured points under the final pose: their projections, and their rows of the matrix A.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FinalProjectionX4 {
    pub(crate) centre: Vector3x4,
    pub(crate) projections: ProjectionX4,
    pub(crate) row: [F64x4; 6],
}

/// Conversion of four points and their projections to the items that a registration reports.
pub(crate) trait ProjectionReporter: Sync {
    /// Reported item of one point.
    type Item: Copy + Send;

    /// Initial value of an item.
    const BLANK: Self::Item;

    /// Converts four measured points to four items. An item is the result of one point in the report of the
    /// registration. `correspondences` has the state of each point, such as its facet and whether the point is in the
    /// fit. `at` has the points in the model frame and their final projections.
    ///
    /// The function must be inlined, so that it is compiled with the vector instructions of its caller.
    fn report_x4(&self, correspondences: [&Correspondence; LANES], at: &FinalProjectionX4) -> [Self::Item; LANES];
}

/// Groups of four points per task of [`report_projections`].
const GROUPS_PER_TASK: usize = 8;

/// Projects all `measured` points once more onto the surface, under the final pose `cmm_from_model`. Returns one item
/// for each point, in the order of the points. `report` makes the item from the point and its projection.
/// `correspondences` has the start facet of each point.
pub(crate) fn report_projections<R: ProjectionReporter>(
    surface: &OffsetSurface,
    measured: &[Point],
    correspondences: &[Correspondence],
    cmm_from_model: &Pose,
    scaling: &Scaling,
    report: &R,
) -> Vec<R::Item> {
    let at_end = FinalPass {
        surface,
        measured,
        correspondences,
        model_from_cmm: cmm_from_model.inverse(),
        scaling,
        reporter: report,
    };
    let arch = pulp::Arch::new();
    // Whole blocks, written in place. The last block is padded with the last point.
    let blocks: Vec<[[R::Item; LANES]; GROUPS_PER_TASK]> = (0..measured.len().div_ceil(LANES * GROUPS_PER_TASK))
        .into_par_iter()
        .with_min_len(CHUNK / (LANES * GROUPS_PER_TASK))
        .map(|block| arch.dispatch(FinalBlock { final_pass: &at_end, block }))
        .collect();
    let mut items = blocks.into_flattened().into_flattened();
    items.truncate(measured.len());
    items
}

/// Data that all points share in the final projection.
struct FinalPass<'a, R> {
    surface: &'a OffsetSurface<'a>,
    measured: &'a [Point],
    correspondences: &'a [Correspondence],
    model_from_cmm: Pose,
    scaling: &'a Scaling,
    reporter: &'a R,
}

struct FinalBlock<'a, R> {
    final_pass: &'a FinalPass<'a, R>,
    block: usize,
}

impl<R: ProjectionReporter> pulp::NullaryFnOnce for FinalBlock<'_, R> {
    type Output = [[R::Item; LANES]; GROUPS_PER_TASK];

    /// Returns the results to report for one block of successive points: [`GROUPS_PER_TASK`] groups of four points,
    /// with one item for each point. In the last block, the last point of the list is repeated to fill the block.
    #[inline(always)]
    fn call(self) -> Self::Output {
        let mut items = [[R::BLANK; LANES]; GROUPS_PER_TASK];
        for (four, items) in items.iter_mut().enumerate() {
            *items = self.final_pass.report_group((self.block * GROUPS_PER_TASK + four) * LANES);
        }
        items
    }
}

impl<R: ProjectionReporter> FinalPass<'_, R> {
    /// Projects four successive points onto the surface and returns the results to report, one item for each point.
    /// `first` is the index of the first of the four points. If fewer than four points are left, the last point of the
    /// list is repeated.
    #[inline(always)]
    fn report_group(&self, first: usize) -> [R::Item; LANES] {
        let end = self.measured.len() - 1;
        let (a, b, c, d) = (first.min(end), (first + 1).min(end), (first + 2).min(end), (first + 3).min(end));
        let correspondences =
            [&self.correspondences[a], &self.correspondences[b], &self.correspondences[c], &self.correspondences[d]];
        let points = [self.measured[a], self.measured[b], self.measured[c], self.measured[d]];
        let centre = transform_x4(&self.model_from_cmm, &points_x4(&points));
        let mut places =
            [correspondences[0].facet, correspondences[1].facet, correspondences[2].facet, correspondences[3].facet];
        let together = self.surface.supports_project_x4() && !places.contains(&FacetIndex::UNKNOWN);
        let feet = match if together { self.surface.project_x4(&centre, &mut places) } else { None } {
            Some(feet) => feet,
            None => self.project_individually(&centre, correspondences),
        };
        self.reporter.report_x4(
            correspondences,
            &FinalProjectionX4 { centre, projections: feet, row: self.scaling.four_rows(&centre, &feet.normal) },
        )
    }

    /// Projects four points one by one onto the surface. Returns the distance in mm and the unit normal of each
    /// projection. `centre` has the four points in the model frame. `correspondences` has the facet of the last
    /// projection of each point; each search starts at this facet.
    ///
    /// In `centre` and in the result, each of the four lanes (elements of a vector register) holds one point.
    #[cold]
    fn project_individually(&self, centre: &Vector3x4, correspondences: [&Correspondence; LANES]) -> ProjectionX4 {
        let foot = |l: usize| {
            let p = Point::new(centre[0].0[l], centre[1].0[l], centre[2].0[l]);
            self.surface.project(&p, correspondences[l].facet)
        };
        let feet: [_; LANES] = std::array::from_fn(foot);
        ProjectionX4 {
            distance_mm: F64x4(feet.map(|f| f.distance_mm)),
            normal: [0, 1, 2].map(|c| F64x4(feet.map(|f| f.normal[c]))),
        }
    }
}

/// Returns the centroid of a cloud and the rms distance of its points from the centroid, in mm.
pub(crate) fn centroid_and_size(points: &[Point]) -> (Point, f64) {
    let n = points.len() as f64;
    // Chunks are added in order, so the bits are the same on any number of threads.
    let parts: Vec<Vector> = points.par_chunks(1 << 14).map(|c| c.iter().map(|p| p.coords).sum()).collect();
    let middle = Point::from(parts.iter().sum::<Vector>() / n);
    let square = |c: &[Point]| c.iter().map(|p| (p - middle).norm_squared()).sum::<f64>();
    let parts: Vec<f64> = points.par_chunks(1 << 14).map(square).collect();
    (middle, (parts.iter().sum::<f64>() / n).sqrt())
}
