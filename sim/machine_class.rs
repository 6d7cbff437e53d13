//! Classes of machines: how large the errors are that a world has if its table states none.

use serde::{Deserialize, Serialize};

use crate::machine_spec::{CmmSpec, GrinderSpec};

/// Class of both machines of a world.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum MachineClass {
    /// Machines in a controlled room: air bearings, a trued wheel, a probe of 0.1 µm.
    Good,
    /// Machines of the shipped recipes: errors of some micrometres that come back in every pass.
    #[default]
    Shipped,
    /// Machines that need maintenance: twice the errors, and touches that are wrong or missing.
    Worn,
}

impl MachineClass {
    /// Returns the errors of a grinder of this class.
    pub fn grinder(self) -> GrinderSpec {
        let shipped = GrinderSpec::default();
        match self {
            Self::Shipped => shipped,
            Self::Good => GrinderSpec {
                wheel_radius_error_um: 20.0,
                setting_error_um: [3.0, -2.0],
                straightness_x_um: [-0.3, -0.2],
                straightness_y_um: [-0.2, -0.15],
                periodic_um: 0.05,
                waviness_um: 0.1,
                following_um: 0.05,
                wear_um: 0.6,
                break_in_um: 0.2,
                thermal_um: 0.8,
                error_copying: 0.05,
                repeatability_um: 0.1,
                ..shipped
            },
            Self::Worn => GrinderSpec {
                wheel_radius_error_um: 150.0,
                setting_error_um: [25.0, -18.0],
                straightness_x_um: [-12.0, -9.0],
                straightness_y_um: [-9.0, -6.0],
                periodic_um: 1.0,
                waviness_um: 1.6,
                following_um: 0.3,
                wear_um: 8.0,
                break_in_um: 4.0,
                thermal_um: 8.0,
                error_copying: 0.3,
                repeatability_um: 0.8,
                ..shipped
            },
        }
    }

    /// Returns the errors of a measuring machine of this class.
    pub fn cmm(self) -> CmmSpec {
        let shipped = CmmSpec::default();
        match self {
            Self::Shipped => shipped,
            Self::Good => CmmSpec { loading_shift_um: 5.0, loading_turn_deg: 0.001, noise_um: 0.1, ..shipped },
            Self::Worn => CmmSpec {
                loading_shift_um: 60.0,
                loading_turn_deg: 0.02,
                noise_um: 0.6,
                outlier_share: 0.002,
                outlier_um: 100.0,
                not_found_share: 0.002,
                ..shipped
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::spec::WorldSpec;

    #[test]
    fn table_overrides_its_class() {
        let spec: WorldSpec = serde_json::from_value(json!({
            "machines": "good", "grinder": { "wear_um": 3.0 }, "cmm": { "outlier_share": 0.1 }
        }))
        .unwrap();
        assert_eq!((spec.grinder.wear_um, spec.grinder.waviness_um), (3.0, 0.1));
        assert_eq!((spec.cmm.outlier_share, spec.cmm.noise_um), (0.1, 0.1));
        let none: WorldSpec = serde_json::from_value(json!({})).unwrap();
        assert_eq!(none, WorldSpec::default());
    }

    #[test]
    fn each_class_is_valid_and_worse_than_the_one_before() {
        let classes = [MachineClass::Good, MachineClass::Shipped, MachineClass::Worn];
        for class in classes {
            WorldSpec { grinder: class.grinder(), cmm: class.cmm(), ..WorldSpec::default() }.check().unwrap();
        }
        assert!(classes.map(|class| class.grinder().waviness_um).is_sorted());
        assert!(classes.map(|class| class.cmm().noise_um).is_sorted());
    }

    #[test]
    fn wrong_tables_are_refused() {
        for table in
            [json!({"machines": "bad"}), json!({"grinder": 3}), json!({"cmm": {"noise": 1.0}}), json!({"x": 1})]
        {
            assert!(serde_json::from_value::<WorldSpec>(table.clone()).is_err(), "{table}");
        }
    }
}
