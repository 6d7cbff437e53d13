//! Simulated machines without errors.

use regrind_sim::spec::{CmmSpec, GrinderSpec};

/// Returns a grinder without errors: it is infinitely stiff, and its wheel leaves no ridges between the tracks.
pub fn perfect_grinder() -> GrinderSpec {
    GrinderSpec {
        wheel_radius_error_um: 0.0,
        setting_error_um: [0.0; 2],
        setting_error_z_um: 0.0,
        part_tilt_urad: [0.0; 2],
        straightness_x_um: [0.0; 2],
        straightness_y_um: [0.0; 2],
        periodic_um: 0.0,
        waviness_um: 0.0,
        following_um: 0.0,
        wear_um: 0.0,
        break_in_um: 0.0,
        thermal_um: 0.0,
        error_copying: 0.0,
        scallops: false,
        repeatability_um: 0.0,
        ..GrinderSpec::default()
    }
}

/// Returns a CMM without noise, on which the part is exactly at the expected position.
pub fn perfect_cmm() -> CmmSpec {
    CmmSpec {
        translation_mm: [0.0; 3],
        rotation_deg: [0.0; 3],
        loading_shift_um: 0.0,
        loading_turn_deg: 0.0,
        noise_um: 0.0,
        ..CmmSpec::default()
    }
}
