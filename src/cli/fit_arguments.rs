//! Arguments of the commands that register measured points: how to read them, and how to fit them.

use std::path::{Path, PathBuf};

use clap::Args;
use regrind::formats::{Columns, Table, Unit, is_map};
use regrind::geometry::Pose;
use regrind::registration::{Coordinate, Loss, Method, ProbeSide, RegistrationOptions, Start};
use regrind::surface::{DistanceModel, PlaneProjection};

use super::choice::word_of;
use super::failure::Failure;
use super::initial::read_pose;
use super::{above_zero, finite_above_zero, finite_from_zero};

/// Columns and units of measured tables, and the distance of the samples of maps, given by a person.
#[derive(Args, Debug)]
pub(super) struct MeasuredTable {
    /// Columns of the measured table, by name or by number from 1, if its header does not identify them
    #[arg(long, value_name = "x=X_act,y=Y_act,z=Z_act")]
    columns: Option<Columns>,
    /// Unit of the measured table: mm, um, nm, cm, m or inch
    #[arg(long)]
    unit: Option<Unit>,
    /// Unit of z in the measured table, if it differs from that of x and y
    #[arg(long, value_name = "UNIT")]
    height_unit: Option<Unit>,
    /// Distance of the samples of a map of heights, in mm along x and y, if the map does not state it
    #[arg(long, value_name = "MM", allow_negative_numbers = true, value_parser = finite_above_zero)]
    sample_spacing: Option<f64>,
}

impl MeasuredTable {
    pub(super) fn table(&self) -> Table {
        Table {
            columns: self.columns.clone(),
            unit: self.unit,
            height_unit: self.height_unit,
            sample_spacing_mm: self.sample_spacing,
        }
    }
}

/// Options of a fit, given by a person.
#[derive(Args, Debug)]
pub(super) struct FitArguments {
    /// Radius of the probe in mm; 0 for a probe without a ball, such as an optical one. Not needed with --method
    /// contact
    #[arg(long, alias = "probe-radius-mm", value_name = "MM", allow_negative_numbers = true, value_parser = finite_from_zero)]
    probe_radius: Option<f64>,
    /// Shape of the surface between the nominal points
    #[arg(long, value_parser = word_of::<DistanceModel>(), default_value = "curved")]
    distance: DistanceModel,
    /// Meaning of the measured points
    #[arg(long, value_parser = word_of::<Method>(), default_value = "offset")]
    method: Method,
    /// Projection of scattered nominal points for the triangulation
    #[arg(long, value_parser = word_of::<PlaneProjection>(), default_value = "auto")]
    pub(super) projection: PlaneProjection,
    /// Locked directions of the pose, separated by commas: they keep their values from --initial, or zero, and no
    /// search is made
    #[arg(long, value_parser = word_of::<Coordinate>(), value_delimiter = ',', value_name = "x,y,z,rx,ry,rz")]
    lock: Vec<Coordinate>,
    /// Loss function of the distance of a point
    #[arg(long, value_parser = word_of::<Loss>(), default_value = "none")]
    loss: Loss,
    /// Start at this pose cmm_from_model instead of searching for one
    #[arg(long, value_name = "FILE")]
    initial: Option<PathBuf>,
    /// Side of the nominal surface on which the probe is
    #[arg(long, value_parser = word_of::<ProbeSide>(), default_value = "auto")]
    side: ProbeSide,
    /// Maximum rms deviation, in mm; a fit with a larger one is refused
    #[arg(long, value_name = "MM", allow_negative_numbers = true, value_parser = finite_above_zero)]
    max_rms: Option<f64>,
    /// Reject points farther off than this many robust standard deviations as outliers; `inf` keeps all
    #[arg(long, value_name = "N", default_value_t = 6.0, allow_negative_numbers = true, value_parser = above_zero)]
    outlier_sigmas: f64,
}

impl FitArguments {
    /// Returns the method of the registration. The method is [`Method::Contact`] (the measured points lie on the surface
    /// itself) if the arguments give a probe radius of 0. Otherwise the method is the one that the arguments name.
    fn method(&self) -> Method {
        if self.probe_radius == Some(0.0) { Method::Contact } else { self.method }
    }

    /// Refuses a map of heights whose points are not registered as points of the surface.
    pub(super) fn check_is_fit_for(&self, measured: &Path) -> Result<(), Failure> {
        if is_map(measured)? && self.method() != Method::Contact {
            return Err(Failure::MapOfContacts { path: measured.to_owned() });
        }
        Ok(())
    }

    pub(super) fn options(&self) -> Result<RegistrationOptions, Failure> {
        let method = self.method();
        let radius_mm = match (self.probe_radius, method) {
            (Some(radius_mm), _) => radius_mm,
            (None, Method::Contact) => 0.0,
            (None, _) => return Err(Failure::NoProbeRadius),
        };
        Ok(RegistrationOptions {
            method,
            distance_model: self.distance,
            loss: self.loss,
            side: self.side,
            locked: Coordinate::locked_flags(&self.lock),
            start: match &self.initial {
                Some(path) => Start::Pose(read_pose(path)?),
                None if self.lock.is_empty() => Start::Search,
                // A search would choose the locked coordinates at random.
                None => Start::Pose(Pose::identity()),
            },
            outlier_sigmas: self.outlier_sigmas,
            rms_limit_mm: self.max_rms,
            ..RegistrationOptions::new(radius_mm)
        })
    }
}
