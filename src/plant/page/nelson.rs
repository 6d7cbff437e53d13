//! Rules of L. S. Nelson for points of a control chart of individuals ("The Shewhart Control Chart: Tests for Special
//! Causes", Journal of Quality Technology 16, 1984, 237-239).
//!
//! A rule marks the point that completes its pattern, and each later point that continues it. Zones are multiples of
//! sigma from the mean: sigma is the mean moving range / 1.128. A point on the boundary of a zone is not beyond it.

/// Number of rules.
pub(super) const RULES: usize = 8;

/// Probability that a point of a process in control breaks each rule, if its values are independent and normal and the
/// mean and sigma are known. By the stationarity of the process these are the shares of the marked points.
pub(super) const FALSE_ALARMS: [f64; RULES] =
    [0.002_700, 0.003_906, 0.002_778, 0.004_574, 0.002_047, 0.004_466, 0.003_261, 0.000_102];

/// Mean and sigma of the values of a process.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Zones {
    pub(super) mean: f64,
    pub(super) sigma: f64,
}

/// Set of rules that a point breaks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Broken(u8);

impl Broken {
    /// Returns true if the point breaks the rule with the number `rule`, 1 to 8.
    pub(super) fn has(self, rule: usize) -> bool {
        (1..=RULES).contains(&rule) && self.0 & (1 << (rule - 1)) != 0
    }

    /// Returns true if the point breaks a rule.
    pub(super) fn any(self) -> bool {
        self.0 != 0
    }

    /// Returns the numbers of the rules that the point breaks, in ascending order.
    pub(super) fn rules(self) -> impl Iterator<Item = usize> {
        (1..=RULES).filter(move |rule| self.has(*rule))
    }

    /// Returns the numbers of the broken rules as a text, such as `1 5`; empty if there are none.
    pub(super) fn numbers(self) -> String {
        self.rules().map(|rule| rule.to_string()).collect::<Vec<_>>().join(" ")
    }

    fn from_rules(broken: [bool; RULES]) -> Self {
        Self(broken.iter().enumerate().fold(0, |bits, (k, is_broken)| bits | (u8::from(*is_broken) << k)))
    }
}

/// Returns the rules that each value breaks. `values` are in the order of measurement. Returns no broken rule if sigma
/// is not above 0: then there are no zones.
pub(super) fn broken_rules(values: &[f64], zones: Zones) -> Vec<Broken> {
    if zones.sigma.is_nan() || zones.sigma <= 0.0 {
        return vec![Broken::default(); values.len()];
    }
    // Distances from the mean in sigma.
    let z: Vec<f64> = values.iter().map(|value| (value - zones.mean) / zones.sigma).collect();
    (0..z.len()).map(|last| rules_at(&z[..=last])).collect()
}

/// Returns the rules that the last of the distances `z` breaks.
fn rules_at(z: &[f64]) -> Broken {
    let sides = [1.0, -1.0];
    let newest = |count: usize| z.len().checked_sub(count).map(|from| &z[from..]);
    let all =
        |count: usize, is_so: &dyn Fn(f64) -> bool| newest(count).is_some_and(|some| some.iter().all(|z| is_so(*z)));
    // The last point itself must be beyond the zone: otherwise the pattern was complete before it.
    let beyond = |zone: f64, at_least: usize, of: usize| {
        sides.iter().any(|side| {
            let some = &z[z.len().saturating_sub(of)..];
            let is_beyond = |z: &f64| side * z > zone;
            some.last().is_some_and(is_beyond) && some.iter().filter(|z| is_beyond(z)).count() >= at_least
        })
    };
    let rises = |side: f64| newest(6).is_some_and(|some| some.windows(2).all(|pair| side * (pair[1] - pair[0]) > 0.0));
    let turns = |three: &[f64]| (three[1] - three[0]) * (three[2] - three[1]) < 0.0;
    let both_sides = || newest(8).is_some_and(|some| some.iter().any(|z| *z > 0.0) && some.iter().any(|z| *z < 0.0));
    Broken::from_rules([
        z.last().is_some_and(|z| z.abs() > 3.0),
        sides.iter().any(|side| all(9, &|z| side * z > 0.0)),
        sides.into_iter().any(rises),
        newest(14).is_some_and(|some| some.windows(3).all(turns)),
        beyond(2.0, 2, 3),
        beyond(1.0, 4, 5),
        all(15, &|z| z.abs() < 1.0),
        all(8, &|z| z.abs() > 1.0) && both_sides(),
    ])
}

/// Returns the number of points that break a rule by chance among `points` of a process in control: the mean, and the
/// number that 99 of 100 such processes do not exceed.
pub(super) fn expected_by_chance(points: usize) -> [f64; 2] {
    // A pattern that continues marks several points, so the number scatters more than that of independent events. The
    // factors are from 6,000 simulated processes of 50 to 250 points, whose limits come from the same points.
    let mean = FALSE_ALARMS.iter().sum::<f64>() * points as f64;
    [mean, mean + 2.33 * (CLUSTERS * mean).sqrt() + 3.0]
}

/// Variance of the number of marked points, divided by its mean.
const CLUSTERS: f64 = 2.6;

#[cfg(test)]
mod tests {
    use super::super::draws::normal_numbers;
    use super::*;

    const UNIT: Zones = Zones { mean: 0.0, sigma: 1.0 };

    /// Returns the rules that each value breaks, as numbers.
    fn numbers(values: &[f64]) -> Vec<String> {
        broken_rules(values, UNIT).into_iter().map(Broken::numbers).collect()
    }

    /// Returns the places at which a rule is broken, from 1.
    fn places(rule: usize, values: &[f64]) -> Vec<usize> {
        let broken = broken_rules(values, UNIT);
        broken.iter().enumerate().filter(|(_, broken)| broken.has(rule)).map(|(k, _)| k + 1).collect()
    }

    #[test]
    fn each_rule_at_hand_made_series() {
        // 1: one point beyond 3 sigma; 3 sigma itself is not beyond.
        assert_eq!(places(1, &[0.0, 3.01, 3.0, -3.2]), [2, 4]);
        // 2: nine on one side; a point on the mean is on neither side.
        let side = [0.1, 0.4, 0.2, 0.5, 0.1, 0.3, 0.2, 0.4, 0.1, 0.3];
        assert_eq!(places(2, &side), [9, 10]);
        assert_eq!(places(2, &[&side[..8], &[0.0, 0.2]].concat()), [0; 0]);
        assert_eq!(places(2, &side.map(|z| -z)), [9, 10]);
        // 3: six points that rise or fall; two equal ones do neither.
        assert_eq!(places(3, &[0.5, -0.9, -0.5, -0.1, 0.2, 0.6, 0.9, 0.8]), [7]);
        assert_eq!(places(3, &[0.9, 0.6, 0.2, -0.1, -0.5, -0.9]), [6]);
        assert_eq!(places(3, &[-0.9, -0.5, -0.5, -0.1, 0.2, 0.6, 0.9]), [0; 0]);
        // 4: fourteen that alternate.
        let swings: Vec<f64> = (0..15).map(|k| if k % 2 == 0 { 0.4 } else { -0.3 }).collect();
        assert_eq!(places(4, &swings), [14, 15]);
        assert_eq!(places(4, &[&swings[..13], &[0.5]].concat()), [0; 0], "13 alternate, and one goes on");
        // 5: two of three beyond 2 sigma on one side.
        assert_eq!(places(5, &[2.1, 0.0, 2.2, 0.0]), [3]);
        assert_eq!(places(5, &[2.1, 0.0, 0.0, 2.2, -2.3, 0.0, 2.5]), [0; 0]);
        assert_eq!(places(5, &[-2.1, -2.4, 0.0]), [2]);
        // 6: four of five beyond 1 sigma on one side.
        assert_eq!(places(6, &[1.1, 1.2, -0.5, 1.3, 1.4, 0.1]), [5]);
        assert_eq!(places(6, &[1.1, -1.2, 1.3, 1.4]), [0; 0]);
        assert_eq!(places(6, &[1.1, 1.2, 1.3, 1.4]), [4]);
        // 7: fifteen within 1 sigma.
        let calm: Vec<f64> = (0..16).map(|k| [0.5, -0.4, 0.1, -0.9][k % 4]).collect();
        assert_eq!(places(7, &calm), [15, 16]);
        assert_eq!(places(7, &[&calm[..14], &[1.0]].concat()), [0; 0]);
        // 8: eight beyond 1 sigma, on both sides.
        assert_eq!(places(8, &[1.1, -1.2, 1.3, 1.4, -1.1, -1.2, 1.2, -1.5]), [8]);
        assert_eq!(places(8, &[1.1; 8]), [0; 0], "on one side it is rule 6");
    }

    #[test]
    fn point_breaks_several_rules() {
        assert_eq!(numbers(&[2.5, 3.5]), ["", "1 5"]);
        let broken = broken_rules(&[4.0], UNIT)[0];
        assert!(broken.has(1) && !broken.has(0) && !broken.has(9) && broken.any());
        // Without a spread there are no zones.
        for sigma in [0.0, -1.0, f64::NAN] {
            assert!(!broken_rules(&[1.0, 2.0], Zones { mean: 0.0, sigma }).iter().any(|broken| broken.any()));
        }
        assert_eq!(broken_rules(&[], UNIT), []);
    }

    #[test]
    fn false_alarms_as_often_as_stated() {
        let values = normal_numbers(250_000, 1984);
        let broken = broken_rules(&values, UNIT);
        for (rule, expected) in (1..).zip(FALSE_ALARMS) {
            let share = broken.iter().filter(|broken| broken.has(rule)).count() as f64 / values.len() as f64;
            // Five standard deviations; a pattern that continues marks up to some points in a row.
            let scatter = 5.0 * (3.0 * expected / values.len() as f64).sqrt();
            assert!((share - expected).abs() < scatter, "rule {rule}: {share} instead of {expected} +- {scatter}");
        }
    }

    #[test]
    fn chance_bound_holds_for_limits_from_the_same_points() {
        for points in [50, 250] {
            let mut beyond = 0;
            for k in 0..400 {
                let values = normal_numbers(points, 7 * k + 1);
                let mean = values.iter().sum::<f64>() / points as f64;
                let steps: f64 = values.windows(2).map(|pair| (pair[1] - pair[0]).abs()).sum();
                let zones = Zones { mean, sigma: steps / (points - 1) as f64 / 1.128 };
                let marked = broken_rules(&values, zones).iter().filter(|broken| broken.any()).count();
                beyond += usize::from(marked as f64 > expected_by_chance(points)[1]);
            }
            assert!(beyond <= 16, "{beyond} of 400 processes of {points} points");
        }
    }
}
