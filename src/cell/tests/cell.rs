//! The machine: whole runs, every judgement, every interruption, every pair of state and event, and whatever chance
//! brings.

use std::time::Duration;

use proptest::prelude::*;
use regrind_cell::*;
use regrind_figures::{Forecast, FormFigures, Interval, PartResponse};

const SECOND: Duration = Duration::from_secs(1);

fn plan() -> CellPlan {
    CellPlan {
        begin_with: FirstStep::Grind,
        max_cycles: 4,
        tolerance: Tolerance {
            pv_mm: 0.007,
            rms_mm: 0.001,
            with_uncertainty: true,
            probability: Tolerance::DEFAULT_PROBABILITY,
            pv_points: PvPoints::All,
        },
        stall_share: 0.02,
        stall_mm: 0.0,
        on_stall: HoldOrStop::Stop,
        on_divergence: HoldOrStop::Hold,
        on_refusal: HoldOrStop::Hold,
        gates: GateLimits {
            min_found_share: 0.95,
            min_coverage: 0.9,
            max_shift_mm: 1.0,
            max_rotation_rad: 0.1,
            max_radius_error_mm: Some(0.002),
        },
        removal_budget_mm: 0.5,
        min_depth_mm: 0.002,
        clear_at_start: false,
        deadlines: Deadlines::default(),
    }
}

fn actor() -> Actor {
    Actor { name: "Ada".into(), station: "console".into() }
}

fn figures(pv_um: f64, rms_um: f64) -> Figures {
    Figures {
        pv_mm: pv_um / 1e3,
        rms_mm: rms_um / 1e3,
        form: None,
        pv_expanded_mm: 0.0003,
        rms_expanded_mm: 0.00005,
        coverage: 0.99,
        points: 1000,
        outliers: 1,
        with_outliers: None,
        shift_mm: 0.05,
        rotation_rad: 0.001,
        weak_directions: vec![],
        warnings: vec![],
        forecast: None,
        pv_998_mm: None,
        response: None,
        removed_mm: Some(0.1),
        unstated: None,
        further_touches: None,
    }
}

fn hold() -> Event {
    Event::Hold { actor: actor(), reason: "coffee".into() }
}

fn resume() -> Event {
    Event::Resume { actor: actor(), reason: String::new() }
}

fn stop() -> Event {
    Event::Stop { actor: actor(), reason: String::new() }
}

fn abort() -> Event {
    Event::Abort { actor: actor(), reason: String::new() }
}

/// Returns the answer that a good world gives to a command.
fn good_answer(command: &Command, figures: &mut dyn FnMut(u32) -> Figures) -> Option<Event> {
    Some(match command.clone() {
        Command::Connect { device } | Command::ClearMachine { device } => {
            Event::Connected { device, boot_id: 7, simulated: true, occupation: Occupation::Idle }
        }
        Command::AskToLoad => Event::LoadConfirmed { actor: actor() },
        Command::LoadPass { cycle } => Event::PassLoaded { cycle },
        Command::LoadPlan { cycle } => Event::PlanLoaded { cycle },
        Command::VerifyClear { device } => Event::Cleared { device },
        Command::AskWhetherClear { device } => Event::ClearConfirmed { actor: actor(), device },
        Command::Prepare { device, cycle } => Event::Prepared { device, cycle },
        Command::StartMachine { device, cycle } => Event::Started { device, cycle },
        Command::HoldMachine { device } => Event::MachineHeld { device },
        Command::ResumeMachine { device } => Event::MachineResumed { device },
        Command::StopMachine { device } => Event::Ended { device, cycle: u32::MAX, result: JobResult::Stopped },
        Command::AbortMachine { device } => Event::AbortConfirmed { device },
        Command::Reconcile { device, cycle } => Event::Reconciled { device, cycle, outcome: Reconciliation::Running },
        Command::Collect { cycle } => Event::Collected { cycle, targets: 1000, found: 999, gate: GateResult::Passed },
        Command::Qualify { cycle } => Event::Qualified { cycle, radius_error_mm: 0.0003 },
        Command::Acknowledge { device } => Event::Acknowledged { device },
        Command::Register { cycle } => Event::Registered { cycle, figures: figures(cycle) },
        Command::Compensate { cycle } => {
            let (max_mm, depth_mm, predicted_pv_mm) = (0.01, 0.02, 0.005);
            let summary = CompensationSummary {
                max_correction_mm: max_mm,
                depth_mm,
                predicted_pv_mm,
                ..CompensationSummary::default()
            };
            Event::Compensated { cycle, summary }
        }
        Command::Announce(_)
        | Command::Raise(_)
        | Command::Withdraw { .. }
        | Command::Refuse { .. }
        | Command::Finish(_) => return None,
    })
}

/// A cell and a good world around it.
struct TestRun<'f> {
    cell: Cell,
    now: Duration,
    commands: Vec<Command>,
    open_commands: Vec<Command>,
    figures: Box<dyn FnMut(u32) -> Figures + 'f>,
}

impl<'f> TestRun<'f> {
    fn new(plan: CellPlan, figures: impl FnMut(u32) -> Figures + 'f) -> Self {
        let cell = Cell::new(plan);
        Self { cell, now: Duration::ZERO, commands: vec![], open_commands: vec![], figures: Box::new(figures) }
    }

    /// A run that is ground twice and then accepted.
    fn accepted_after_two_passes() -> Self {
        Self::new(plan(), |cycle| if cycle == 1 { figures(27.0, 6.0) } else { figures(6.0, 0.9) })
    }

    fn send(&mut self, event: Event) -> Vec<Command> {
        self.now += SECOND / 100;
        let commands = self.cell.handle(self.now, event);
        self.commands.extend(commands.clone());
        self.open_commands.extend(commands.clone());
        commands
    }

    /// Answers the oldest open command, or lets a running job end; false if nothing is left to do.
    fn step(&mut self) -> bool {
        while !self.open_commands.is_empty() {
            let command = self.open_commands.remove(0);
            if let Some(mut event) = good_answer(&command, &mut self.figures) {
                if let Event::Ended { cycle, .. } = &mut event {
                    *cycle = self.cell.cycle();
                }
                self.send(event);
                return true;
            }
        }
        let running = match self.cell.state() {
            State::Execute(Phase::Grind(JobStep::Run)) => Some(Device::Grinder),
            State::Execute(Phase::Measure(JobStep::Run)) => Some(Device::Cmm),
            _ => None,
        };
        let cycle = self.cell.cycle();
        running.map(|device| self.send(Event::Ended { device, cycle, result: JobResult::Complete })).is_some()
    }

    fn run_to_rest(&mut self) -> &mut Self {
        for _ in 0..2000 {
            if !self.step() {
                return self;
            }
        }
        panic!("the run does not come to rest: {}", self.cell.state());
    }

    fn run_until(&mut self, state: State) -> &mut Self {
        for _ in 0..2000 {
            if self.cell.state() == state {
                return self;
            }
            assert!(self.step(), "came to rest in {} and not {state}", self.cell.state());
        }
        panic!("never in {state}");
    }

    fn start(&mut self) -> &mut Self {
        self.send(Event::Start { actor: actor() });
        self
    }

    fn ending(&self) -> Option<&Ending> {
        self.commands.iter().find_map(|c| if let Command::Finish(ending) = c { Some(ending) } else { None })
    }

    fn alarms(&self) -> Vec<AlarmId> {
        self.commands.iter().filter_map(|c| if let Command::Raise(alarm) = c { Some(alarm.id) } else { None }).collect()
    }

    fn judgements(&self) -> impl Iterator<Item = &Judgement> {
        self.commands.iter().filter_map(|c| if let Command::Announce(judgement) = c { Some(judgement) } else { None })
    }

    fn verdicts(&self) -> Vec<Verdict> {
        self.judgements().map(|judgement| judgement.verdict).collect()
    }

    fn starts(&self) -> Vec<(Device, u32)> {
        let start =
            |c: &Command| if let Command::StartMachine { device, cycle } = c { Some((*device, *cycle)) } else { None };
        self.commands.iter().filter_map(start).collect()
    }
}

#[test]
fn run_accepted_after_two_cycles() {
    let mut run = TestRun::accepted_after_two_passes();
    run.start().run_to_rest();
    assert_eq!(run.cell.state(), State::Complete);
    assert!(matches!(run.ending(), Some(Ending::Accepted { cycle: 2, .. })), "{:?}", run.ending());
    use Device::{Cmm, Grinder};
    assert_eq!(run.starts(), [(Grinder, 1), (Cmm, 1), (Grinder, 2), (Cmm, 2)]);
    assert_eq!(run.verdicts(), [Verdict::Continue, Verdict::Accept]);
    assert_eq!(run.alarms(), []);
    assert!(!run.commands.iter().any(|c| matches!(c, Command::Refuse { .. })));
    assert_eq!(run.cell.next_deadline(), None);
}

#[test]
fn run_begins_with_measurement() {
    let begin_with = FirstStep::Measure;
    let mut run = TestRun::new(CellPlan { begin_with, ..plan() }, |_| figures(5.0, 0.5));
    run.start().run_to_rest();
    assert_eq!(run.starts(), [(Device::Cmm, 1)]);
    assert_eq!(run.cell.state(), State::Complete);
    // Two allowed passes are three cycles: the first cycle has no pass.
    let mut run =
        TestRun::new(CellPlan { begin_with, max_cycles: 2, ..plan() }, |k| figures(40.0 - 8.0 * f64::from(k), 5.0));
    run.start().run_to_rest();
    assert_eq!(run.verdicts().last(), Some(&Verdict::MaxCycles));
    assert_eq!((run.cell.cycle(), run.cell.plan().max_cycle_number()), (3, 3));
}

#[test]
fn with_uncertainty_decides_acceptance() {
    for (with_uncertainty, accepted) in [(true, false), (false, true)] {
        let tolerance = Tolerance { with_uncertainty, ..plan().tolerance };
        let mut run = TestRun::new(CellPlan { tolerance, max_cycles: 1, ..plan() }, |_| figures(7.0, 1.0));
        run.start().run_to_rest();
        assert_eq!(run.cell.state() == State::Complete, accepted);
    }
}

#[test]
fn verdict_sequences_and_end_states() {
    type Sequence = fn(u32) -> Figures;
    let sequences: [(Sequence, &[Verdict], State); 7] = [
        (
            |k| figures(30.0 - 2.0 * f64::from(k), 6.0),
            &[Verdict::Continue, Verdict::Continue, Verdict::Continue, Verdict::MaxCycles],
            State::Stopped,
        ),
        (|_| figures(30.0, 6.0), &[Verdict::Continue, Verdict::Stalled], State::Stopped),
        (
            |k| figures(30.0 * 1.1_f64.powi(k as i32), 6.0),
            &[Verdict::Continue, Verdict::Diverging, Verdict::Diverging],
            State::Held(Phase::Compensate),
        ),
        (
            |k| Figures { response: (k > 1).then_some(PartResponse::SignFlipped), ..figures(20.0 * f64::from(k), 6.0) },
            &[Verdict::Continue, Verdict::WrongResponse],
            State::Held(Phase::Compensate),
        ),
        (
            |k| Figures { response: (k > 1).then_some(PartResponse::Mirrored), ..figures(20.0, 6.0) },
            &[Verdict::Continue, Verdict::WrongResponse],
            State::Held(Phase::Compensate),
        ),
        (
            |k| Figures { response: (k > 1).then_some(PartResponse::NoEffect), ..figures(20.0, 6.0) },
            &[Verdict::Continue, Verdict::WrongResponse],
            State::Held(Phase::Compensate),
        ),
        (|_| Figures { removed_mm: Some(0.499), ..figures(30.0, 6.0) }, &[Verdict::BudgetSpent], State::Stopped),
    ];
    for (i, (figures, verdicts, state)) in sequences.into_iter().enumerate() {
        let mut run = TestRun::new(plan(), figures);
        run.start().run_to_rest();
        assert_eq!((run.verdicts().as_slice(), run.cell.state()), (verdicts, state), "sequence {i}");
        assert!(!run.alarms().is_empty(), "sequence {i} raises an alarm");
        assert!(state != State::Stopped || matches!(run.ending(), Some(Ending::NotAccepted { .. })));
    }
}

#[test]
fn parameter_beyond_holds_until_resume() {
    let mut run = TestRun::new(plan(), |_| figures(30.0, 6.0));
    run.start().run_until(State::Execute(Phase::Compensate));
    let asks = vec!["wheel radius is off by 249.00 um".to_owned()];
    let summary = CompensationSummary { confirmations_required: asks, ..CompensationSummary::default() };
    run.send(Event::Compensated { cycle: 1, summary });
    assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Send)));
    let alarms = run.alarms();
    assert!(alarms.contains(&AlarmId::ParameterBeyond), "{alarms:?}");
    run.send(resume());
    run.run_until(State::Execute(Phase::Grind(JobStep::Run)));
    assert_eq!(run.starts().iter().filter(|(device, _)| *device == Device::Grinder).count(), 2);
}

#[test]
fn stalled_below_stall_limit() {
    // From 6.0 to 5.5 um is 8 %, and half a micrometre.
    let judged = |stall_um: f64, forecast_um: Option<f64>| {
        let forecast = forecast_um.map(|um| Forecast { rms_mm: 1e-3 * um, sigma_mm: 1e-5, floor_mm: None });
        let mut run = TestRun::new(CellPlan { stall_mm: 1e-3 * stall_um, ..plan() }, move |k| match k {
            1 => figures(30.0, 6.0),
            _ => Figures { forecast, ..figures(30.0, 5.5) },
        });
        run.start().run_to_rest();
        run.verdicts()[1]
    };
    assert_eq!(judged(0.0, None), Verdict::Continue);
    assert_eq!(judged(0.45, None), Verdict::Continue);
    assert_eq!(judged(0.55, None), Verdict::Stalled);
    assert_eq!(judged(0.45, Some(5.0)), Verdict::Continue, "half a micrometre is expected of the next pass too");
    assert_eq!(judged(0.45, Some(5.1)), Verdict::Stalled);
}

#[test]
fn tolerance_compare_uses_pv_998() {
    let most = Tolerance { pv_points: PvPoints::MostPoints, ..plan().tolerance };
    let found = Figures { pv_998_mm: Some(0.0069), ..figures(8.0, 0.5) };
    let [pv, rms] = most.compare(&found);
    assert_eq!(
        (pv.name, pv.median_mm, pv.limit_mm, pv.conformity),
        ("PV 99.8 %", 0.0069, 0.007, Conformity::Undecided)
    );
    assert_eq!((rms.name, rms.conformity), ("RMS", Conformity::Within));
    assert!((rms.expanded_mm - 0.00005).abs() < 1e-15, "{rms:?}");
    let [alone, _] = Tolerance { with_uncertainty: false, ..most }.compare(&found);
    assert!((alone.expanded_mm - 0.0003).abs() < 1e-15 && alone.conformity == Conformity::Within, "{alone:?}");
    // Of all points, also where the others are known; and of all points where they are not.
    for (tolerance, found) in [(plan().tolerance, &found), (most, &figures(8.0, 0.5))] {
        let [pv, _] = tolerance.compare(found);
        assert_eq!((pv.name, pv.median_mm, pv.conformity), ("PV", 0.008, Conformity::Beyond));
    }
}

#[test]
fn conformity_by_acceptance_probability() {
    // u = 0.1 um below a limit of 1 um.
    let below = |deviates: f64| {
        let rms = Interval::from_expanded(1e-3 - 1e-4 * deviates, 1.959_963_984_540_054e-4);
        let form = FormFigures {
            pv: Interval::from_expanded(1e-3, 1e-4),
            pv_998: Interval::from_expanded(1e-3, 1e-4),
            rms,
            noise_sigma_mm: 3e-4,
        };
        Figures { form: Some(form), ..figures(1.0, 0.5) }
    };
    let judged = |probability: f64, deviates: f64| {
        let [_, rms] = Tolerance { probability, ..plan().tolerance }.compare(&below(deviates));
        rms.conformity
    };
    for (probability, deviate) in [(0.5, 0.0), (0.9, 1.281_55), (0.975, 1.959_96), (0.99, 2.326_35), (0.995, 2.575_83)]
    {
        assert_eq!(judged(probability, deviate + 1e-3), Conformity::Within, "{probability}");
        assert_eq!(judged(probability, -deviate - 1e-3), Conformity::Beyond, "{probability}");
        let near = if probability == 0.5 { Conformity::Beyond } else { Conformity::Undecided };
        assert_eq!(judged(probability, deviate - 1e-3), near, "{probability}");
    }
    let [pv, rms] = plan().tolerance.compare(&below(1.0));
    assert!((rms.probability_in_tolerance.unwrap() - 0.841_345).abs() < 1e-5, "{rms:?}");
    assert_eq!(rms.probability_in_words().unwrap(), "P(in tolerance) = 84.1 %");
    assert_eq!(pv.probability_in_words().unwrap(), "P(in tolerance) > 99.9 %");
    let open = Tolerance { pv_mm: f64::INFINITY, ..plan().tolerance };
    assert_eq!(open.compare(&below(1.0))[0].probability_in_tolerance, None);
    // Whoever has no number accepts nothing.
    assert_eq!(judged(f64::NAN, 5.0), Conformity::Beyond);
    // A plan of an earlier record asks for what was always asked for, and one that asks for that is recorded as it was.
    let recorded = serde_json::to_value(plan()).unwrap();
    assert!(recorded["tolerance"].get("probability").is_none());
    assert_eq!(serde_json::from_value::<CellPlan>(recorded).unwrap(), plan());
    let other = CellPlan { tolerance: Tolerance { probability: 0.99, ..plan().tolerance }, ..plan() };
    assert_eq!(serde_json::from_value::<CellPlan>(serde_json::to_value(&other).unwrap()).unwrap(), other);
}

fn figures_with_form(pv_um: [f64; 3], rms_um: [f64; 3]) -> Figures {
    let of = |[low, median, high]: [f64; 3]| Interval {
        low_mm: low / 1e3,
        high_mm: high / 1e3,
        ..Interval::from_expanded(median / 1e3, 0.0)
    };
    let form = FormFigures { pv: of(pv_um), pv_998: of(pv_um), rms: of(rms_um), noise_sigma_mm: 3e-4 };
    Figures { form: Some(form), ..figures(9.0, 1.2) }
}

#[test]
fn conformity_by_form_interval() {
    // Nine micrometres of points, of which the probe made two.
    let judged = |pv_um: [f64; 3], rms_um: [f64; 3]| {
        plan().tolerance.compare(&figures_with_form(pv_um, rms_um)).map(|of| of.conformity)
    };
    let good = [0.4, 0.5, 0.6];
    assert_eq!(judged([6.0, 6.4, 7.0], good), [Conformity::Within; 2], "the most that it may be is the limit");
    assert_eq!(judged([6.0, 6.4, 7.01], good)[0], Conformity::Undecided);
    assert_eq!(judged([7.0, 7.9, 8.4], good)[0], Conformity::Undecided);
    assert_eq!(judged([7.01, 7.9, 8.4], good)[0], Conformity::Beyond);
    assert_eq!(judged([0.0, 0.1, 0.2], [0.0, 0.02, 0.04]), [Conformity::Within; 2], "known from above alone");
    let [pv, rms] = plan().tolerance.compare(&figures_with_form([6.0, 6.4, 7.0], good));
    assert_eq!((pv.median_mm, pv.interval_mm, rms.median_mm), (0.0064, [0.006, 0.007], 0.0005));
    let alone = Tolerance { with_uncertainty: false, ..plan().tolerance };
    assert_eq!(alone.compare(&figures_with_form([6.0, 6.9, 8.0], good))[0].conformity, Conformity::Within);
    // A median outside of its own interval is none.
    for broken in [[2.0, 1.0, 3.0], [0.5, f64::NAN, 1.0], [1.0, 4.0, 3.0]] {
        let mut run = TestRun::new(plan(), move |_| figures_with_form(broken, good));
        run.start().run_to_rest();
        assert!(run.verdicts().is_empty(), "{broken:?}");
    }
}

#[test]
fn judgement_omits_absent_limit() {
    let open = CellPlan { tolerance: Tolerance { pv_mm: f64::INFINITY, ..plan().tolerance }, ..plan() };
    let mut run = TestRun::new(open, |_| figures_with_form([6.0, 6.4, 7.0], [0.4, 0.5, 0.6]));
    run.start().run_to_rest();
    let told = run.judgements().last().unwrap().reason.clone();
    assert!(
        told.contains("PV: 6.40 µm ± ") && told.contains(" µm; RMS: 0.50 µm ± ") && !told.contains("inf"),
        "{told}"
    );
}

#[test]
fn forecast_at_floor_stalls() {
    // 1.2 um are found, give or take 0.15; another pass is expected to leave 1.05, and none can leave less than the
    // floor.
    let with_floor = |floor_um: f64| {
        let forecast = Some(Forecast { rms_mm: 1.05e-3, sigma_mm: 2e-5, floor_mm: Some(floor_um / 1e3) });
        let mut run = TestRun::new(plan(), move |k| match k {
            1 => figures(30.0, 6.0),
            _ => Figures { forecast, ..figures_with_form([5.0, 5.5, 6.0], [1.05, 1.2, 1.35]) },
        });
        run.start().run_to_rest();
        run.verdicts()[1]
    };
    assert_eq!(with_floor(1.0), Verdict::Continue);
    assert_eq!(with_floor(1.06), Verdict::Stalled);
}

#[test]
fn ending_names_best_cycle() {
    let mut run = TestRun::new(CellPlan { max_cycles: 3, ..plan() }, |k| match k {
        1 => figures(30.0, 6.0),
        2 => figures(9.0, 1.5),
        _ => figures(9.3, 1.52),
    });
    run.start().run_to_rest();
    let Some(Ending::NotAccepted { reason, .. }) = run.ending() else { panic!("{:?}", run.ending()) };
    for piece in ["best cycle 2", "PV 9.00 µm", "RMS 1.50 µm", "cycle-2"] {
        assert!(reason.contains(piece), "{piece}: {reason}");
    }
}

#[test]
fn infinite_tolerance_round_trip() {
    let open = Tolerance { pv_mm: f64::INFINITY, ..plan().tolerance };
    let recorded = serde_json::to_string(&open).unwrap();
    assert!(recorded.contains("\"pv_mm\":null"), "{recorded}");
    assert_eq!(serde_json::from_str::<Tolerance>(&recorded).unwrap(), open);
    assert_eq!(open.compare(&figures(1e9, 0.5))[0].conformity, Conformity::Within);
}

#[test]
fn verdict_accept_undecided_or_stalled() {
    // Limits of 7 and 1 um, uncertainties of 0.3 and 0.05 um: within means the figure and its uncertainty, beyond the
    // figure without it.
    let expecting = |rms_um: f64| Forecast { rms_mm: rms_um / 1e3, sigma_mm: 2e-5, floor_mm: Some(rms_um / 1.2e3) };
    let judged = |pv_um: f64, rms_um: f64, next_rms_um: f64| {
        let mut run = TestRun::new(plan(), |k| match k {
            1 => figures(30.0, 6.0),
            _ => Figures { forecast: Some(expecting(next_rms_um)), ..figures(pv_um, rms_um) },
        });
        run.start().run_to_rest();
        run.verdicts()[1]
    };
    assert_eq!(judged(6.7, 0.95, 0.9), Verdict::Accept);
    assert_eq!(judged(6.71, 0.9, 0.95), Verdict::Undecided, "PV reaches over its limit, and no pass makes it better");
    assert_eq!(judged(6.0, 0.96, 0.95), Verdict::Undecided);
    assert_eq!(judged(7.3, 0.96, 0.95), Verdict::Undecided);
    assert_eq!(
        judged(7.31, 0.96, 0.95),
        Verdict::Stalled,
        "beyond its limit for certain, and no gain is to be expected"
    );
    assert_eq!(judged(6.71, 0.96, 0.5), Verdict::Continue, "what is undecided is ground again where that is worth it");
    // A contribution that is not stated counts as 0, and the verdict says so.
    let mut run = TestRun::new(plan(), |_| Figures { unstated: Some([4, 8]), ..figures(5.0, 0.5) });
    run.start().run_to_rest();
    let said = |words: &str| {
        run.commands.iter().any(|c| matches!(c, Command::Announce(judgement) if judgement.reason.contains(words)))
    };
    assert!(said("4 of 8 contributions"));
    // By the figure alone, where the recipe says so.
    let alone = CellPlan { tolerance: Tolerance { with_uncertainty: false, ..plan().tolerance }, ..plan() };
    let mut run = TestRun::new(alone, |_| figures(6.99, 0.99));
    run.start().run_to_rest();
    assert_eq!(run.verdicts(), [Verdict::Accept]);
}

#[test]
fn outliers_hold_until_remeasured() {
    let left_out = |pv_um: f64, rms_um: f64| {
        let places = "point 17 at (1.0, 2.0) mm by -50.0 um".to_owned();
        Some(Box::new(OutlierFigures {
            pv_mm: pv_um / 1e3,
            rms_mm: rms_um / 1e3,
            description: places,
            can_repeat: false,
        }))
    };
    let again = |of: Option<Box<OutlierFigures>>| of.map(|of| Box::new(OutlierFigures { can_repeat: true, ..*of }));
    // Limits of 7 and 1 um: beyond one of them with the point, so the part is measured again, and accepted without it.
    for (pv_um, rms_um) in [(50.0, 0.9), (6.9, 1.2), (50.0, 1.2)] {
        let mut run = TestRun::new(plan(), |k| Figures {
            with_outliers: if k == 1 { left_out(pv_um, rms_um) } else { None },
            ..figures(5.0, 0.5)
        });
        run.start().run_to_rest();
        assert_eq!((run.alarms(), run.verdicts()), (vec![AlarmId::LeftOut], vec![Verdict::LeftOut]));
        assert_eq!(run.cell.state(), State::Held(Phase::Measure(JobStep::Send)));
        assert!(
            run.commands
                .iter()
                .any(|c| matches!(c, Command::Raise(alarm) if alarm.event.contains("point 17 at (1.0, 2.0) mm")))
        );
        run.send(resume());
        run.run_to_rest();
        assert_eq!(run.verdicts(), [Verdict::LeftOut, Verdict::Accept]);
        assert_eq!(run.starts(), [(Device::Grinder, 1), (Device::Cmm, 1), (Device::Cmm, 2)]);
    }
    // The same measurement goes on with the places that can be touched again by themselves, as often as somebody
    // resumes.
    let mut run = TestRun::new(plan(), |_| Figures { with_outliers: again(left_out(50.0, 1.2)), ..figures(5.0, 0.5) });
    run.start().run_to_rest();
    for times in 1..=3 {
        assert_eq!(run.verdicts(), vec![Verdict::LeftOut; times]);
        assert_eq!(run.cell.state(), State::Held(Phase::Measure(JobStep::Send)));
        assert_eq!(run.cell.cycle(), 1);
        run.send(resume());
        run.run_to_rest();
    }
    // Where the limits are kept with it too, nothing is open; and where they are not kept without it, another pass is.
    let mut run = TestRun::new(plan(), |_| Figures { with_outliers: left_out(6.9, 0.9), ..figures(5.0, 0.5) });
    run.start().run_to_rest();
    assert_eq!(run.verdicts(), [Verdict::Accept]);
    let mut run = TestRun::new(plan(), |k| match k {
        1 => Figures { with_outliers: left_out(50.0, 6.5), ..figures(30.0, 6.0) },
        _ => figures(5.0, 0.5),
    });
    run.start().run_to_rest();
    assert_eq!(run.verdicts(), [Verdict::Continue, Verdict::Accept]);
}

#[test]
fn stalled_without_forecast_improvement() {
    let expecting = |rms_um: f64| Some(Forecast { rms_mm: rms_um / 1e3, sigma_mm: 2e-5, floor_mm: None });
    // The first pass goes on whatever is forecast: nobody knows yet what a correction can do.
    let mut run = TestRun::new(plan(), |k| Figures {
        forecast: expecting(6.0),
        ..figures(30.0 - 10.0 * f64::from(k), 6.0 - 2.0 * f64::from(k - 1))
    });
    run.start().run_to_rest();
    assert_eq!(run.verdicts(), [Verdict::Continue, Verdict::Stalled]);
    assert!(matches!(run.ending(), Some(Ending::NotAccepted { .. })) && run.cell.state() == State::Stopped);
    let told = &run.judgements().last().unwrap().reason;
    for piece in ["no improvement expected", "RMS 6.00 µm ± 0.02 µm"] {
        assert!(told.contains(piece), "{piece}: {told}");
    }
}

#[test]
fn diverging_once_continues() {
    let mut run =
        TestRun::new(plan(), |k| [figures(20.0, 4.0), figures(22.0, 4.0), figures(6.0, 0.9)][k as usize - 1].clone());
    run.start().run_to_rest();
    assert_eq!(run.verdicts(), [Verdict::Continue, Verdict::Diverging, Verdict::Accept]);
}

/// The states through which an undisturbed run goes.
fn undisturbed_states() -> Vec<State> {
    let mut run = TestRun::accepted_after_two_passes();
    run.start();
    let mut way = vec![run.cell.state()];
    while run.step() {
        if !way.contains(&run.cell.state()) {
            way.push(run.cell.state());
        }
    }
    way.retain(|state| !state.is_end());
    way
}

/// Interrupts a run at every step, and resumes it from where it is held then: it comes to the same end by the same
/// starts.
fn hold_at_every_step(what: &str, interrupt: fn(&mut TestRun)) {
    for state in undisturbed_states().into_iter().filter(|state| *state != State::Completing) {
        let mut run = TestRun::accepted_after_two_passes();
        run.start().run_until(state);
        interrupt(&mut run);
        assert!(matches!(run.cell.state(), State::Held(_)), "{what} at {state}: {}", run.cell.state());
        run.send(resume());
        run.run_to_rest();
        assert_eq!(run.cell.state(), State::Complete, "{what} at {state}");
        let mut starts = run.starts();
        starts.dedup();
        assert_eq!(starts.len(), 4, "{what} at {state}: {starts:?}");
    }
}

#[test]
fn hold_and_resume_at_every_step() {
    hold_at_every_step("held", |run| {
        run.send(hold());
        run.run_to_rest();
        let before = run.commands.len();
        run.send(hold());
        assert_eq!(run.commands.len(), before, "a second hold changes nothing");
    });
}

#[test]
fn hold_and_resume_running_machine() {
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
    assert_eq!(run.send(hold()), [Command::HoldMachine { device: Device::Grinder }]);
    run.run_until(State::Held(Phase::Grind(JobStep::Run)));
    assert_eq!(run.send(resume()), [Command::ResumeMachine { device: Device::Grinder }]);
}

#[test]
fn stop_at_every_step() {
    for state in undisturbed_states() {
        let mut run = TestRun::accepted_after_two_passes();
        run.start().run_until(state);
        run.open_commands.clear();
        run.send(stop());
        run.run_to_rest();
        let expected = if state == State::Completing { State::Completing } else { State::Stopped };
        assert_eq!(run.cell.state(), expected, "stopped at {state}");
        assert!(!matches!(run.ending(), Some(Ending::Stopped { ordered: false, .. })), "a person ordered it");
        assert!(!run.commands.iter().any(|c| matches!(c, Command::AbortMachine { .. })));
    }
}

#[test]
fn abort_and_fault_at_every_step() {
    let fault = Event::Fault { device: Device::Grinder, code: 5, message: "drive".into() };
    for state in undisturbed_states() {
        for event in [abort(), fault.clone()] {
            let mut run = TestRun::accepted_after_two_passes();
            run.start().run_until(state);
            run.open_commands.clear();
            let before = run.commands.len();
            run.send(event);
            run.run_to_rest();
            assert_eq!(run.cell.state(), State::Aborted, "aborted at {state}");
            for command in &run.commands[before..] {
                let safe = matches!(
                    command,
                    Command::AbortMachine { .. } | Command::VerifyClear { .. } | Command::Raise(_) | Command::Finish(_)
                );
                assert!(safe, "{command:?} after an abort at {state}");
            }
            assert!(matches!(run.ending(), Some(Ending::Aborted { confirmed: true, .. })));
        }
    }
}

#[test]
fn unconfirmed_abort_ends_by_timeout() {
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run))).send(abort());
    for _ in 0..2 {
        let due = run.cell.next_deadline().unwrap();
        assert!(due <= run.now + 2 * SECOND);
        run.now = due;
        run.send(Event::Deadline);
    }
    assert_eq!(run.cell.state(), State::Aborted);
    assert_eq!(run.cell.unconfirmed(), Device::BOTH);
    assert!(run.cell.in_words().contains("neither machine"), "{}", run.cell.in_words());
    assert!(matches!(run.ending(), Some(Ending::Aborted { confirmed: false, .. })));
    let alarm =
        run.commands.iter().find_map(|c| if let Command::Raise(a) = c { Some(a.clone()) } else { None }).unwrap();
    assert_eq!(alarm.id, AlarmId::StopNotConfirmed);
    assert!(alarm.remedy[0].contains("emergency circuit"), "{alarm:?}");
    // One of them has.
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run))).send(abort());
    run.send(Event::AbortConfirmed { device: Device::Cmm });
    for _ in 0..2 {
        run.now = run.cell.next_deadline().unwrap();
        run.send(Event::Deadline);
    }
    assert_eq!(run.cell.unconfirmed(), [Device::Grinder]);
    assert_eq!(run.cell.state(), State::Aborted);
    assert!(run.cell.in_words().contains("the grinder"), "{}", run.cell.in_words());
    // Both have, and neither was seen clear.
    let mut run = TestRun::accepted_after_two_passes();
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run))).send(abort());
    run.run_to_rest();
    assert_eq!((run.cell.in_words(), run.cell.unconfirmed()), ("Aborted".to_owned(), vec![]));
}

#[test]
fn link_loss_suspends_and_reconciles() {
    let cases = [
        (Reconciliation::Running, State::Execute(Phase::Grind(JobStep::Run))),
        (Reconciliation::Held, State::Held(Phase::Grind(JobStep::Run))),
        (Reconciliation::Ended(JobResult::Complete), State::Execute(Phase::Grind(JobStep::Acknowledge))),
        // It was seen at it: whatever it says, no second pass is started without a person.
        (Reconciliation::NotStarted, State::Held(Phase::Grind(JobStep::Reconcile))),
        (Reconciliation::Unknown("no memory".into()), State::Held(Phase::Grind(JobStep::Reconcile))),
    ];
    for (outcome, state) in cases {
        let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
        run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
        let device = Device::Grinder;
        run.send(Event::LinkLost { device, reason: "silent".into() });
        assert_eq!(run.cell.state(), State::Suspended(Phase::Grind(JobStep::Reconcile)));
        let commands = run.send(Event::LinkBack { device, boot_id: 7 });
        assert!(commands.contains(&Command::Reconcile { device, cycle: 1 }), "{commands:?}");
        run.send(Event::Reconciled { device, cycle: 1, outcome });
        assert_eq!(run.cell.state(), state);
    }
}

#[test]
fn started_job_is_never_restarted() {
    let not_started = |device| Event::Reconciled { device, cycle: 1, outcome: Reconciliation::NotStarted };
    let device = Device::Grinder;
    let reconcile = State::Execute(Phase::Grind(JobStep::Reconcile));
    // START was lost on its way: proven not to have begun, and asked for once more.
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Start)));
    run.send(Event::StartUnknown { device, cycle: 1, reason: "silent".into() });
    assert_eq!(run.cell.state(), reconcile);
    run.send(not_started(device));
    assert_eq!(run.cell.state(), State::Execute(Phase::Grind(JobStep::Send)));
    // Its answer was lost, and it was seen to move, to hold or to end before it was asked; then it forgets.
    for seen in [
        Event::Progressed { device, done: 1, total: 9 },
        Event::MachineHeld { device },
        Event::Started { device, cycle: 1 },
    ] {
        let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
        run.start().run_until(State::Execute(Phase::Grind(JobStep::Start)));
        run.send(Event::StartUnknown { device, cycle: 1, reason: "silent".into() });
        run.open_commands.clear();
        run.send(seen.clone());
        run.send(Event::LinkLost { device, reason: "silent".into() });
        run.send(Event::LinkBack { device, boot_id: 7 });
        if matches!(run.cell.state(), State::Held(_)) {
            run.send(resume());
        }
        let starts = run.starts();
        run.send(not_started(device));
        run.run_to_rest();
        assert_eq!(run.starts(), starts, "{seen:?}");
    }
    // Its answer was lost and it was found at work; then it forgets, with this program started anew in between or not.
    for is_restarted in [false, true] {
        let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
        run.start().run_until(State::Execute(Phase::Grind(JobStep::Start)));
        run.send(Event::StartUnknown { device, cycle: 1, reason: "silent".into() });
        run.send(Event::Reconciled { device, cycle: 1, outcome: Reconciliation::Running });
        if is_restarted {
            run.open_commands.clear();
            run.send(Event::Restarted { actor: actor() });
            while !run.open_commands.contains(&Command::Reconcile { device, cycle: 1 }) {
                assert!(run.step());
            }
            run.open_commands.clear();
        } else {
            run.send(Event::LinkLost { device, reason: "silent".into() });
            run.send(Event::LinkBack { device, boot_id: 7 });
        }
        let starts = run.starts();
        run.send(not_started(device));
        assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Reconcile)), "restarted: {is_restarted}");
        assert!(run.cell.alarms().any(|alarm| alarm.id == AlarmId::JobVanished));
        run.send(resume());
        run.send(not_started(device));
        assert_eq!(run.starts(), starts, "a person may ask again, and nothing is started by that");
        // A person ends it: the part is measured as it is.
        run.open_commands.clear();
        run.send(Event::DeclaredOver { actor: actor(), device, evidence: "stands at the park position".into() });
        run.run_until(State::Held(Phase::Transfer));
    }
}

#[test]
fn machine_reboot_requires_operator() {
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
    let device = Device::Grinder;
    run.send(Event::LinkLost { device, reason: "silent".into() });
    run.send(Event::LinkBack { device, boot_id: 8 });
    assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Reconcile)));
    run.open_commands.clear();
    run.send(Event::DeclaredOver { actor: actor(), device, evidence: "stands at the park position".into() });
    run.run_until(State::Held(Phase::Transfer));
    run.send(resume());
    run.run_to_rest();
    assert_eq!(run.cell.state(), State::Complete);
    assert_eq!(run.starts(), [(device, 1), (Device::Cmm, 1)], "the pass is not repeated");
}

#[test]
fn condition_lost_suspends_until_back() {
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Measure(JobStep::Run)));
    let condition = Condition::Signals;
    // What is missing at one machine is not back because the other one has it.
    for device in Device::BOTH {
        run.send(Event::ConditionLost { device, condition, message: "22.3 of at most 21 degrees".into() });
    }
    run.run_until(State::Suspended(Phase::Measure(JobStep::Run)));
    run.send(Event::ConditionBack { device: Device::Cmm, condition });
    assert_eq!(run.cell.state(), State::Suspended(Phase::Measure(JobStep::Run)));
    run.send(Event::ConditionBack { device: Device::Grinder, condition });
    run.run_to_rest();
    assert_eq!(run.cell.state(), State::Complete);
}

#[test]
fn failed_gate_holds_and_remeasures() {
    let failures = [
        (GateFailure::NoPart, AlarmId::NoPart),
        (GateFailure::Contacts, AlarmId::Contacts),
        (GateFailure::Inches, AlarmId::Inches),
        (GateFailure::Coverage("3 of 9".into()), AlarmId::Coverage),
        (GateFailure::Moved("3 points".into()), AlarmId::PartMoved),
    ];
    for (reason, alarm) in failures {
        let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
        run.start().run_until(State::Execute(Phase::Measure(JobStep::Collect)));
        run.open_commands.clear();
        run.send(Event::Collected { cycle: 1, targets: 9, found: 9, gate: GateResult::Failed(reason) });
        run.run_to_rest();
        assert_eq!((run.alarms(), run.cell.state()), (vec![alarm], State::Held(Phase::Measure(JobStep::Send))));
        assert!(!run.commands.iter().any(|c| matches!(c, Command::Register { .. })));
        run.send(resume());
        run.run_to_rest();
        assert_eq!(run.starts(), [(Device::Grinder, 1), (Device::Cmm, 1), (Device::Cmm, 2)]);
    }
}

#[test]
fn figures_outside_gates_hold() {
    let bad = [
        (Figures { shift_mm: 9.0, ..figures(1.0, 0.1) }, AlarmId::PartMisplaced),
        (Figures { rotation_rad: 3.1, ..figures(1.0, 0.1) }, AlarmId::PartMisplaced),
        (Figures { coverage: 0.2, ..figures(1.0, 0.1) }, AlarmId::Coverage),
        (Figures { pv_mm: f64::NAN, ..figures(1.0, 0.1) }, AlarmId::RegistrationFailed),
        (Figures { rms_mm: -1.0, ..figures(1.0, 0.1) }, AlarmId::RegistrationFailed),
    ];
    for (figures, alarm) in bad {
        let mut run = TestRun::new(plan(), |_| figures.clone());
        run.start().run_to_rest();
        assert_eq!((run.alarms(), run.verdicts()), (vec![alarm], vec![]));
        assert!(matches!(run.cell.state(), State::Held(_)));
    }
    for radius_error_mm in [0.010, -0.010, f64::NAN] {
        let mut run = TestRun::new(plan(), |_| figures(1.0, 0.1));
        run.start().run_until(State::Execute(Phase::Measure(JobStep::Qualify)));
        run.open_commands.clear();
        run.send(Event::Qualified { cycle: 1, radius_error_mm });
        run.run_to_rest();
        assert_eq!(run.alarms(), [AlarmId::ProbeRadius]);
    }
}

#[test]
fn start_requires_other_machine_clear() {
    let mut run = TestRun::new(plan(), |_| figures(1.0, 0.1));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Prepare)));
    run.open_commands.clear();
    run.send(Event::Obstructed { device: Device::Cmm, message: "moved by hand".into() });
    run.send(Event::Prepared { device: Device::Grinder, cycle: 1 });
    assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Send)));
    assert_eq!(run.starts(), []);
}

#[test]
fn restart_at_every_step() {
    hold_at_every_step("restarted", |run| {
        run.open_commands.clear();
        run.send(Event::Restarted { actor: actor() });
        run.run_to_rest();
    });
    // Where the part is accepted already there is nothing to go on with.
    let mut run = TestRun::accepted_after_two_passes();
    run.start().run_until(State::Completing).open_commands.clear();
    run.send(Event::Restarted { actor: actor() });
    assert_eq!(run.cell.state(), State::Complete);
}

#[test]
fn abort_spares_machine_of_another_run() {
    let mut run = TestRun::accepted_after_two_passes();
    run.start().run_until(State::Execute(Phase::Measure(JobStep::Run))).open_commands.clear();
    run.send(Event::Restarted { actor: actor() });
    let reason = ConnectionRefusal::AtAnotherJob("EXECUTE with job 9, cycle 1".into());
    run.send(Event::NotConnected { device: Device::Grinder, reason });
    assert!(run.alarms().contains(&AlarmId::NotIdle));
    let commands = run.send(Event::Abort { actor: actor(), reason: String::new() });
    assert!(commands.contains(&Command::AbortMachine { device: Device::Cmm }), "{commands:?}");
    assert!(!commands.contains(&Command::AbortMachine { device: Device::Grinder }), "{commands:?}");
}

#[test]
fn declared_over_remeasures_lost_result() {
    let mut run = TestRun::accepted_after_two_passes();
    run.start().run_until(State::Execute(Phase::Measure(JobStep::Collect))).open_commands.clear();
    run.send(hold());
    let (device, request) = (Device::Cmm, MachineRequest::Collect);
    run.send(Event::Refused { device, request, reason: "it holds no result".into() });
    assert_eq!(run.cell.state(), State::Held(Phase::Measure(JobStep::Collect)));
    run.send(Event::DeclaredOver { actor: actor(), device, evidence: "it was switched off".into() });
    run.run_until(State::Held(Phase::Measure(JobStep::Send)));
    assert_eq!(run.cell.cycle(), 2);
}

#[test]
fn declared_over_discards_result_first() {
    let over = |device| Event::DeclaredOver { actor: actor(), device, evidence: "it stands at its end".into() };
    for (device, next) in
        [(Device::Grinder, State::Held(Phase::Transfer)), (Device::Cmm, State::Held(Phase::Measure(JobStep::Send)))]
    {
        let job = |step| if device == Device::Cmm { Phase::Measure(step) } else { Phase::Grind(step) };
        let lost = |run: &mut TestRun| {
            run.start().run_until(State::Execute(job(JobStep::Run)));
            run.send(Event::LinkLost { device, reason: "silent".into() });
            run.send(hold());
        };
        // The machine may stand there with its result, and would refuse to be prepared for ever.
        let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
        lost(&mut run);
        run.send(Event::LinkBack { device, boot_id: 7 });
        let outcome = Reconciliation::Unknown("no memory".into());
        run.send(Event::Reconciled { device, cycle: 1, outcome });
        assert_eq!(run.cell.state(), State::Held(job(JobStep::Reconcile)));
        assert_eq!(run.send(over(device)), [Command::Acknowledge { device }]);
        assert_eq!(run.cell.state(), State::Holding(job(JobStep::Discard)), "its result is given back first");
        run.send(Event::Acknowledged { device });
        assert_eq!(run.cell.state(), next);
        // It says no: a person sees to it, and it is asked once more.
        let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
        lost(&mut run);
        run.send(Event::LinkBack { device, boot_id: 8 });
        run.send(over(device));
        run.send(Event::Refused { device, request: MachineRequest::Acknowledge, reason: "HELD with job 9".into() });
        assert_eq!(run.cell.state(), State::Held(job(JobStep::Discard)));
        assert!(run.alarms().contains(&AlarmId::MachineRefused));
        assert_eq!(run.send(resume()).last(), Some(&Command::Acknowledge { device }));
        run.send(Event::Acknowledged { device });
        assert_eq!(run.cell.state(), next);
        // It cannot be reached yet: it is asked when it is back, also if it was switched off.
        let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
        lost(&mut run);
        run.now += Duration::from_secs(3600);
        run.send(Event::Deadline);
        assert_eq!(run.cell.state(), State::Held(job(JobStep::Reconcile)));
        assert_eq!(run.send(over(device)), []);
        assert_eq!(run.cell.state(), State::Held(job(JobStep::Discard)));
        run.send(Event::LinkBack { device, boot_id: 8 });
        assert_eq!(run.cell.state(), State::Held(job(JobStep::Discard)), "nobody has to say so twice");
        assert_eq!(run.send(resume()).last(), Some(&Command::Acknowledge { device }));
    }
}

#[test]
fn uncommanded_motion_holds_again() {
    let device = Device::Cmm;
    let progress = |done| Event::Progressed { device, done, total: 10 };
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Send)));
    run.send(hold());
    run.run_until(State::Held(Phase::Grind(JobStep::Send)));
    for _ in 0..2 {
        assert_eq!(run.send(progress(3)).last(), Some(&Command::HoldMachine { device }));
        assert_eq!(run.send(progress(4)), [], "it is on its way");
        run.send(Event::MachineHeld { device });
    }
    assert_eq!(run.alarms(), [AlarmId::MovesUnasked; 2]);
}

#[test]
fn record_failure_prevents_start() {
    let mut run = TestRun::new(plan(), |_| figures(1.0, 0.1));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Prepare)));
    run.send(Event::RecordFailed { reason: RecordFailure::DiskFull("runs".into()) });
    run.run_to_rest();
    assert_eq!((run.cell.state(), run.starts()), (State::Held(Phase::Grind(JobStep::Send)), vec![]));
    assert_eq!(run.alarms(), [AlarmId::DiskFull]);
}

#[test]
fn command_not_on_record_holds_cell() {
    for state in undisturbed_states() {
        let mut run = TestRun::accepted_after_two_passes();
        run.start().run_until(state).open_commands.clear();
        let commands = run.commands.len();
        run.send(Event::RecordFailed { reason: RecordFailure::DiskFull("runs".into()) });
        run.send(match state.phase().and_then(Phase::job) {
            Some((device, JobStep::Start)) => {
                Event::Refused { device, request: MachineRequest::Start, reason: "it is not on record".into() }
            }
            _ => Event::NotOnRecord { command: "the one that was under way".into() },
        });
        match state {
            // They hold, and end, whether that is on record or not.
            State::Execute(Phase::Grind(JobStep::Run) | Phase::Measure(JobStep::Run)) => {
                assert!(matches!(run.commands.last(), Some(Command::HoldMachine { .. })), "{state}");
            }
            State::Idle | State::Completing => assert_eq!(run.cell.state(), state),
            _ => {
                assert!(matches!(run.cell.state(), State::Held(_)), "{state}: {}", run.cell.state());
                run.open_commands.clear();
                run.send(resume());
                assert!(run.commands.len() > commands, "{state}");
                run.run_to_rest();
                assert_eq!(run.cell.state(), State::Complete, "{state}");
            }
        }
    }
    // The order to go on does not come on record: the cell is held as before, and may be told once more.
    let mut run = TestRun::accepted_after_two_passes();
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
    run.send(hold());
    run.run_until(State::Held(Phase::Grind(JobStep::Run)));
    run.send(resume());
    run.open_commands.clear();
    run.send(Event::NotOnRecord { command: "resume_machine grinder".into() });
    assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Run)));
    // Nor does what gives a result back at the end.
    let mut run = TestRun::accepted_after_two_passes();
    run.start().run_until(State::Execute(Phase::Measure(JobStep::Collect)));
    run.send(stop());
    run.open_commands.clear();
    assert_eq!(run.cell.state(), State::Stopping);
    run.send(Event::NotOnRecord { command: "acknowledge cmm".into() });
    assert_eq!(run.cell.state(), State::Stopped);
}

#[test]
fn repeated_failure_holds_after_five() {
    let device = Device::Grinder;
    let lost = || Event::LinkLost { device, reason: "the check number is wrong".into() };
    let back = || Event::LinkBack { device, boot_id: 7 };
    let raised = |run: &TestRun, id| run.alarms().iter().filter(|alarm| **alarm == id).count();
    let send = Phase::Grind(JobStep::Send);
    // A payload that never arrives whole.
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(send));
    for k in 1..=50 {
        run.open_commands.clear();
        run.send(lost());
        assert_eq!(run.cell.state(), if k < 5 { State::Suspended(send) } else { State::Held(send) }, "{k}");
        run.send(back());
    }
    assert_eq!((raised(&run, AlarmId::LinkLost), raised(&run, AlarmId::FailsAgain)), (5, 1));
    // A person lets it try again, and it works.
    run.open_commands.clear();
    run.send(resume());
    run.run_to_rest();
    assert_eq!(run.cell.state(), State::Complete);
    // A START that is never heard.
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start();
    for _ in 0..50 {
        if run.cell.state() == State::Held(send) {
            break;
        }
        run.run_until(State::Execute(Phase::Grind(JobStep::Start))).open_commands.clear();
        run.send(Event::StartUnknown { device, cycle: 1, reason: "not acknowledged".into() });
        run.open_commands.clear();
        run.send(Event::Reconciled { device, cycle: 1, outcome: Reconciliation::NotStarted });
    }
    assert_eq!((run.cell.state(), run.starts().len(), run.alarms().len()), (State::Held(send), 5, 1));
    // Slowly: three times are enough where a minute has passed; what is long ago does not count.
    for (pause, state) in [(31 * SECOND, State::Held(send)), (121 * SECOND, State::Suspended(send))] {
        let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
        run.start().run_until(State::Execute(send));
        for _ in 0..3 {
            run.open_commands.clear();
            run.send(lost());
            assert!(matches!(run.cell.state(), State::Suspended(_) | State::Held(_)));
            if run.cell.state() == State::Suspended(send) && state == run.cell.state()
                || raised(&run, AlarmId::FailsAgain) == 0
            {
                run.send(back());
            }
            run.now += pause;
        }
        assert_eq!(raised(&run, AlarmId::FailsAgain) > 0, state == State::Held(send), "{pause:?}");
    }
    // A job that gets on between two failures is not in vain.
    let run_step = Phase::Grind(JobStep::Run);
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(run_step));
    for done in 1..20 {
        run.send(Event::Progressed { device, done, total: 100 });
        run.send(lost());
        run.send(back());
        run.open_commands.clear();
        run.send(Event::Reconciled { device, cycle: 1, outcome: Reconciliation::Running });
        assert_eq!(run.cell.state(), State::Execute(run_step), "{done}");
    }
    // The other machine does not keep the one that works from its job, and is not told for ever.
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(run_step));
    let other = Device::Cmm;
    for _ in 0..50 {
        run.send(Event::LinkLost { device: other, reason: "silent".into() });
        run.send(Event::LinkBack { device: other, boot_id: 7 });
        assert_eq!(run.cell.state(), State::Execute(run_step));
    }
    assert_eq!((raised(&run, AlarmId::LinkLost), raised(&run, AlarmId::FailsAgain)), (5, 0));
    // Nor does it silence the one that works.
    run.send(lost());
    assert_eq!(
        (run.cell.state(), raised(&run, AlarmId::LinkLost)),
        (State::Suspended(Phase::Grind(JobStep::Reconcile)), 6)
    );
}

#[test]
fn flapping_link_holds_or_aborts_motion() {
    let device = Device::Grinder;
    let (run_step, asked) = (Phase::Grind(JobStep::Run), Phase::Grind(JobStep::Reconcile));
    let lost = || Event::LinkLost { device, reason: "the check number is wrong".into() };
    let back = || Event::LinkBack { device, boot_id: 7 };
    let running = || Event::Reconciled { device, cycle: 1, outcome: Reconciliation::Running };
    let in_vain = || {
        let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
        run.start().run_until(State::Execute(run_step));
        for _ in 0..5 {
            run.open_commands.clear();
            run.send(lost());
            if run.cell.state() != State::Holding(asked) {
                run.send(back());
                run.send(running());
            }
        }
        assert_eq!(run.cell.state(), State::Holding(asked), "it is not shown as held before it stands");
        assert!(run.alarms().contains(&AlarmId::FailsAgain));
        run
    };
    // It is asked however often it has failed, and told to hold.
    let mut run = in_vain();
    assert_eq!(run.send(back()).last(), Some(&Command::Reconcile { device, cycle: 1 }));
    assert_eq!(run.send(running()).last(), Some(&Command::HoldMachine { device }));
    run.send(Event::MachineHeld { device });
    assert_eq!(run.cell.state(), State::Held(run_step));
    // A person resumes while the line is down once more: that is told.
    run.send(lost());
    run.send(resume());
    assert!(run.cell.alarms().any(|alarm| alarm.id == AlarmId::LinkLost), "{:?}", run.cell.state());
    // However often the line comes back, what does not come to a stand is aborted.
    let mut run = in_vain();
    let began = run.now;
    while run.cell.state() == State::Holding(asked) && run.now - began < 120 * SECOND {
        run.now += SECOND;
        run.send(Event::Deadline);
        if run.cell.state() == State::Holding(asked) {
            run.send(back());
            run.send(lost());
        }
    }
    assert_eq!(run.cell.state(), State::Aborting);
    // The question is not on record, and the machine has to stand all the same.
    let mut run = in_vain();
    run.send(back());
    assert_eq!(run.send(Event::NotOnRecord { command: "reconcile grinder".into() }), [Command::HoldMachine { device }]);
    assert_eq!(run.cell.state(), State::Holding(asked));
}

#[test]
fn unrecorded_reconcile_never_shows_held() {
    let boot = |device| Event::LinkBack { device, boot_id: 7 };
    for (device, run_phase, asked) in [
        (Device::Grinder, Phase::Grind(JobStep::Run), Phase::Grind(JobStep::Reconcile)),
        (Device::Cmm, Phase::Measure(JobStep::Run), Phase::Measure(JobStep::Reconcile)),
    ] {
        let lost = || Event::LinkLost { device, reason: "silent".into() };
        let not_on_record = || Event::NotOnRecord { command: format!("reconcile {device}") };
        let full = || Event::RecordFailed { reason: RecordFailure::DiskFull("runs".into()) };
        // The disk fails while the link of the moving machine is lost, or after it is back.
        for disk_first in [true, false] {
            let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
            run.start().run_until(State::Execute(run_phase)).open_commands.clear();
            run.send(lost());
            if disk_first {
                run.send(full());
            }
            run.send(boot(device));
            assert_eq!(run.send(not_on_record()), [Command::HoldMachine { device }], "{device}, {disk_first}");
            assert_eq!(run.cell.state(), State::Holding(asked), "the outcome is unknown: {device}, {disk_first}");
            run.send(Event::MachineHeld { device });
            assert_eq!(run.cell.state(), State::Held(run_phase), "{device}, {disk_first}");
        }
    }
}

#[test]
fn stop_during_prepare_of_next_cycle() {
    let device = Device::Grinder;
    let mut run = TestRun::new(plan(), |_| figures(30.0, 6.0));
    run.start().run_until(State::Execute(Phase::Measure(JobStep::Run)));
    run.run_until(State::Execute(Phase::Grind(JobStep::Prepare))).open_commands.clear();
    let cycle = run.cell.cycle();
    assert!(cycle > 1);
    assert_eq!(run.send(stop()).last(), Some(&Command::StopMachine { device }));
    let ended = |device| Event::Ended { device, cycle: cycle - 1, result: JobResult::Stopped };
    assert!(
        matches!(run.send(ended(Device::Cmm))[..], [Command::Refuse { .. }]),
        "the other machine says nothing of it"
    );
    assert_eq!(run.send(ended(device)).last(), Some(&Command::Acknowledge { device }));
    run.send(Event::Acknowledged { device });
    assert_eq!(run.cell.state(), State::Stopped);
}

#[test]
fn stop_ignores_withdrawn_command() {
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
    run.send(stop());
    for command in ["resume_machine grinder", "reconcile grinder"] {
        run.send(Event::NotOnRecord { command: command.into() });
        assert_eq!(run.cell.state(), State::Stopping, "{command}");
    }
}

#[test]
fn declared_over_with_active_job() {
    let device = Device::Grinder;
    let over = || Event::DeclaredOver { actor: actor(), device, evidence: "it stands".into() };
    let (asked, discard) = (Phase::Grind(JobStep::Reconcile), Phase::Grind(JobStep::Discard));
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
    run.send(hold());
    run.send(Event::LinkLost { device, reason: "silent".into() });
    run.send(Event::MachineHeld { device });
    run.send(Event::LinkLost { device, reason: "silent".into() });
    // It cannot be asked yet: to say so twice changes nothing.
    for _ in 0..2 {
        run.send(over());
        assert_eq!(run.cell.state(), State::Held(discard));
    }
    run.send(Event::LinkBack { device, boot_id: 7 });
    assert_eq!(run.send(over()), [Command::Acknowledge { device }]);
    run.send(Event::Refused { device, request: MachineRequest::Discard, reason: "HELD with job 7".into() });
    assert_eq!(run.cell.state(), State::Held(asked), "it is found out what it does before anything else moves");
    run.send(resume());
    run.send(Event::Reconciled { device, cycle: 1, outcome: Reconciliation::Held });
    assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Run)));
}

#[test]
fn vanished_job_reconciles_and_holds() {
    for (device, next) in
        [(Device::Grinder, State::Held(Phase::Transfer)), (Device::Cmm, State::Held(Phase::Measure(JobStep::Send)))]
    {
        let job = |step| if device == Device::Cmm { Phase::Measure(step) } else { Phase::Grind(step) };
        let vanished = || Event::JobVanished { device, reason: "it is IDLE".into() };
        type Comes = fn(&mut TestRun);
        let ways: [(&str, Comes, State); 3] = [
            ("at work", |_| {}, State::Execute(job(JobStep::Reconcile))),
            (
                "held",
                |run| {
                    run.send(hold());
                    run.run_to_rest();
                },
                State::Holding(job(JobStep::Reconcile)),
            ),
            (
                "being resumed",
                |run| {
                    run.send(hold());
                    run.run_to_rest();
                    run.send(resume());
                    run.open_commands.clear();
                },
                State::Execute(job(JobStep::Reconcile)),
            ),
        ];
        for (what, comes, asks) in ways {
            let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
            run.start().run_until(State::Execute(job(JobStep::Run)));
            comes(&mut run);
            let cycle = run.cell.cycle();
            let commands = run.send(vanished());
            assert_eq!(commands.last(), Some(&Command::Reconcile { device, cycle }), "{what}");
            assert_eq!(run.cell.state(), asks, "{what}");
            assert_eq!(run.send(vanished()), [], "it is asked already");
            run.open_commands.clear();
            let starts = run.starts();
            run.send(Event::Reconciled { device, cycle, outcome: Reconciliation::NotStarted });
            assert_eq!(run.cell.state(), State::Held(job(JobStep::Reconcile)), "{what}");
            assert!(run.cell.alarms().any(|alarm| alarm.id == AlarmId::JobVanished));
            run.send(Event::DeclaredOver { actor: actor(), device, evidence: "it stands".into() });
            run.run_until(next);
            assert_eq!(run.starts(), starts, "{what}: nothing is started by that");
        }
    }
}

#[test]
fn declared_over_drops_refused_result() {
    let cases = [
        (Phase::Grind(JobStep::Acknowledge), Device::Grinder, State::Held(Phase::Transfer)),
        (Phase::Measure(JobStep::Acknowledge), Device::Cmm, State::Held(Phase::Register)),
    ];
    for (phase, device, next) in cases {
        let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
        run.start().run_until(State::Execute(phase)).open_commands.clear();
        let over = Event::DeclaredOver { actor: actor(), device, evidence: "its panel shows none".into() };
        assert!(matches!(run.send(over.clone())[..], [Command::Refuse { .. }]), "nobody is asked yet");
        run.send(Event::Refused { device, request: MachineRequest::Acknowledge, reason: "another result".into() });
        assert_eq!(run.cell.state(), State::Held(phase));
        run.send(over);
        assert_eq!(run.cell.state(), next);
    }
}

#[test]
fn unconfirmed_stop_aborts() {
    let device = Device::Grinder;
    for is_told in [true, false] {
        let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
        run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
        run.send(stop());
        assert_eq!(run.cell.state(), State::Stopping);
        if is_told {
            run.send(Event::Refused {
                device,
                request: MachineRequest::Stop,
                reason: "it is EXECUTE 5 s later".into(),
            });
        } else {
            run.now += Duration::from_secs(3600);
            run.send(Event::Deadline);
        }
        assert_eq!(run.cell.state(), State::Aborting);
        assert_eq!(run.alarms(), [AlarmId::StopNotConfirmed]);
    }
}

#[test]
fn control_lost_raises_alarm() {
    for state in undisturbed_states() {
        let mut run = TestRun::accepted_after_two_passes();
        run.start().run_until(state);
        run.send(Event::ControlLost { reason: String::new() });
        assert_eq!(run.cell.state(), state);
        assert!(run.cell.alarms().any(|alarm| alarm.id == AlarmId::ControlLost));
        run.send(Event::ControlBack);
        assert!(!run.cell.alarms().any(|alarm| alarm.id == AlarmId::ControlLost));
        run.run_to_rest();
        assert_eq!(run.cell.state(), State::Complete);
    }
}

#[test]
fn transition_table_is_complete() {
    let rows = transition_table();
    let states: std::collections::BTreeSet<_> = rows.iter().map(|row| row.state).collect();
    let events: std::collections::BTreeSet<_> = rows.iter().map(|row| row.event.clone()).collect();
    assert_eq!(rows.len(), states.len() * events.len());
    use StateName::*;
    let packml = [Idle, Starting, Execute, Holding, Held, Unholding, Suspending, Suspended, Unsuspending];
    for name in packml.into_iter().chain([Stopping, Stopped, Aborting, Aborted, Completing, Complete]) {
        assert!(states.iter().any(|state| state.name() == name), "{name} is never reached");
    }
    for row in &rows {
        for answer in &row.answers {
            assert!(!row.state.is_end() || (answer.commands.is_empty() && answer.next == row.state), "{row:?}");
            assert!(!answer.is_refusal() || answer.next == row.state || row.event == "resume", "{row:?}");
            let begins = answer.commands.iter().any(|c| c.starts_with("start_machine"));
            assert!(!begins || row.event.starts_with("prepared"), "{row:?}");
        }
        if row.event == "abort" || row.event.starts_with("fault") {
            let ends = |next| matches!(next, State::Aborting | State::Aborted);
            assert!(row.state.is_end() || row.answers.iter().all(|a| ends(a.next)), "{row:?}");
        }
        // Nothing leads out of the safe sequence before the machines were seen to stand, also no order.
        if row.state == State::Aborting {
            assert!(row.answers.iter().all(|a| matches!(a.next, State::Aborting | State::Aborted)), "{row:?}");
        }
    }
    eprintln!("{} states, {} events, {} pairs", states.len(), events.len(), rows.len());
    // A run is gone on with only by a program of the same table: what changes it changes its version too.
    let known = (13, 14_051_191_806_763_656_341);
    assert_eq!(
        (TABLE_VERSION, fingerprint(&rows)),
        known,
        "the table has changed: raise TABLE_VERSION, and write both here"
    );
}

/// FNV-1a of the whole table, with the names that are recorded.
fn fingerprint(rows: &[TransitionRow]) -> u64 {
    let fnv = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
    let text = |row: &TransitionRow| {
        let answers: Vec<_> = row.answers.iter().map(|answer| (answer.next, &answer.commands)).collect();
        serde_json::to_string(&(row.state, &row.event, answers)).unwrap()
    };
    rows.iter().fold(0xcbf2_9ce4_8422_2325, |hash, row| text(row).bytes().fold(hash, fnv))
}

#[test]
fn event_and_command_names_match_serde() {
    for event in sample_events(1) {
        assert_eq!(serde_json::to_value(&event).unwrap()["event"], event.name());
    }
    for device in Device::BOTH {
        assert_eq!(serde_json::to_value(device).unwrap(), device.name());
        let command = Command::StartMachine { device, cycle: 1 };
        assert_eq!(
            command.name(),
            format!("{} {device}", serde_json::to_value(&command).unwrap()["command"].as_str().unwrap())
        );
    }
}

#[test]
fn alarm_names_device_code_and_message() {
    let mut run = TestRun::new(plan(), |_| figures(1.0, 0.1));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
    run.send(Event::Fault { device: Device::Grinder, code: 5, message: "drive".into() });
    let Some(Command::Raise(alarm)) = run.commands.iter().find(|c| matches!(c, Command::Raise(_))) else { panic!() };
    assert_eq!(alarm.id, AlarmId::MachineFault);
    assert!(alarm.event.contains("grinder, fault 5, drive"), "{}", alarm.event);
    assert!(AlarmId::ALL.len() > 30);
}

#[test]
fn clear_confirmed_lapses_at_next_start() {
    let asked = |commands: &[Command]| commands.iter().any(|c| matches!(c, Command::AskWhetherClear { .. }));
    let word = |device| Event::ClearConfirmed { actor: actor(), device };
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    // Who loaded the part has seen both machines clear of it: nobody is asked before the first start.
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Clear)));
    run.open_commands.clear();
    assert!(!asked(&run.send(Event::ClearUnknown { device: Device::Cmm })));
    run.run_until(State::Execute(Phase::Transfer));
    // The grinder was started since: nothing opens the gate but a word, and that is waited for without end.
    run.open_commands.clear();
    assert!(asked(&run.send(Event::ClearUnknown { device: Device::Grinder })));
    assert_eq!((run.cell.state(), run.cell.next_deadline()), (State::Execute(Phase::Transfer), None));
    run.send(word(Device::Cmm));
    assert_eq!(run.cell.state(), State::Execute(Phase::Transfer), "the word was about the other machine");
    // A hold while a person is asked takes no answer.
    run.send(Event::Hold { actor: actor(), reason: String::new() });
    assert_eq!(run.cell.state(), State::Held(Phase::Transfer));
    run.open_commands.clear();
    // An early word counts: the fresh look that follows asks nobody.
    run.send(word(Device::Grinder));
    run.send(Event::Resume { actor: actor(), reason: String::new() });
    run.open_commands.clear();
    assert!(!asked(&run.send(Event::ClearUnknown { device: Device::Grinder })));
    assert_eq!(run.cell.state(), State::Execute(Phase::Measure(JobStep::Send)));
    // Nobody has to look once more when the part is accepted.
    run.run_until(State::Completing).open_commands.clear();
    for device in Device::BOTH {
        assert!(!asked(&run.send(Event::ClearUnknown { device })));
    }
    assert!(matches!(run.ending(), Some(Ending::Accepted { .. })), "{:?}", run.ending());
}

/// A pass that was told to hold, and the link lost before the machine said that it stands.
fn lost_while_holding<'f>() -> TestRun<'f> {
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
    let commands = run.send(hold());
    assert!(commands.contains(&Command::HoldMachine { device: Device::Grinder }), "{commands:?}");
    run.open_commands.clear();
    run.send(Event::LinkLost { device: Device::Grinder, reason: "silent".into() });
    run
}

#[test]
fn held_requires_machine_confirmation() {
    let device = Device::Grinder;
    let mut run = lost_while_holding();
    let due = run.cell.next_deadline().unwrap();
    assert_eq!(run.cell.state(), State::Holding(Phase::Grind(JobStep::Reconcile)), "nobody has seen it stand");
    // The link flaps, and the machine grinds on: it is told again, and the time to stand is not given anew.
    for _ in 0..3 {
        assert_eq!(
            run.send(Event::LinkBack { device, boot_id: 7 }).last(),
            Some(&Command::Reconcile { device, cycle: 1 })
        );
        let commands = run.send(Event::Reconciled { device, cycle: 1, outcome: Reconciliation::Running });
        assert_eq!(commands, [Command::HoldMachine { device }]);
        assert_eq!(run.cell.state(), State::Holding(Phase::Grind(JobStep::Run)));
        assert_eq!(run.cell.next_deadline(), Some(due));
        run.send(Event::LinkLost { device, reason: "silent".into() });
        assert_eq!(run.cell.next_deadline(), Some(due));
    }
    run.send(Event::LinkBack { device, boot_id: 7 });
    run.send(Event::Reconciled { device, cycle: 1, outcome: Reconciliation::Held });
    assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Run)));
}

#[test]
fn unconfirmed_hold_aborts() {
    let mut run = lost_while_holding();
    run.now = run.cell.next_deadline().unwrap();
    let commands = run.send(Event::Deadline);
    assert!(commands.contains(&Command::AbortMachine { device: Device::Grinder }), "{commands:?}");
    assert!(run.alarms().contains(&AlarmId::HoldNotConfirmed));
}

#[test]
fn reconnect_holds_running_machine() {
    // Suspended by the lost link, then held by a person: the machine may still grind.
    let device = Device::Grinder;
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
    run.send(Event::LinkLost { device, reason: "silent".into() });
    run.send(hold());
    assert_eq!(run.cell.state(), State::Holding(Phase::Grind(JobStep::Reconcile)));
    run.now = run.cell.next_deadline().unwrap();
    run.send(Event::Deadline);
    assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Reconcile)));
    assert_eq!(run.cell.state().unconfirmed(), Some(device));
    let message = run.cell.state().to_string();
    assert!(message.contains("the grinder"), "{message}");
    run.send(Event::LinkBack { device, boot_id: 7 });
    let commands = run.send(Event::Reconciled { device, cycle: 1, outcome: Reconciliation::Running });
    assert_eq!(commands.last(), Some(&Command::HoldMachine { device }));
    run.send(Event::MachineHeld { device });
    assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Run)));
    assert_eq!(run.cell.state().unconfirmed(), None);
}

#[test]
fn unholding_ignores_stale_machine_held() {
    let device = Device::Grinder;
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
    run.send(hold());
    run.run_until(State::Held(Phase::Grind(JobStep::Run)));
    assert_eq!(run.send(resume()), [Command::ResumeMachine { device }]);
    // The first look after its link has come back, while RESUME is on its way: Held would not be true for long.
    assert_eq!(run.send(Event::MachineHeld { device }), []);
    assert_eq!(run.cell.state(), State::Unholding(Phase::Grind(JobStep::Run)));
    assert_eq!(run.send(Event::MachineResumed { device }), [], "nobody else had it go on");
    assert_eq!(run.cell.state(), State::Execute(Phase::Grind(JobStep::Run)));
    // Held by itself again, it is.
    run.send(Event::MachineHeld { device });
    assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Run)));
    assert!(run.alarms().contains(&AlarmId::MachineHeldItself));
}

#[test]
fn motion_while_held_commands_hold() {
    let device = Device::Grinder;
    let moves = Event::Progressed { device, done: 17, total: 1000 };
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
    run.send(hold());
    run.run_until(State::Held(Phase::Grind(JobStep::Run)));
    let commands = run.send(moves.clone());
    assert_eq!(commands.last(), Some(&Command::HoldMachine { device }));
    assert_eq!(run.cell.state(), State::Holding(Phase::Grind(JobStep::Run)), "what moves is not held");
    assert!(run.alarms().contains(&AlarmId::MovesUnasked));
    // It says no: only the safe sequence is left.
    let commands = run.send(Event::Refused { device, request: MachineRequest::Hold, reason: "local".into() });
    assert!(commands.contains(&Command::AbortMachine { device }), "{commands:?}");
    // The machine that has no job of this phase.
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Measure(JobStep::Send)));
    run.send(hold());
    run.run_until(State::Held(Phase::Measure(JobStep::Send)));
    run.open_commands.clear();
    assert_eq!(run.send(moves.clone()).last(), Some(&Command::HoldMachine { device }));
    assert_eq!(run.send(moves), [], "told once");
}

#[test]
fn manual_mode_holds_and_blocks_start() {
    let by_hand = |device| Event::NotAutomatic { device, message: "it is in manual mode".into() };
    for device in Device::BOTH {
        let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
        run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
        let commands = run.send(by_hand(device));
        let Some(Command::Raise(alarm)) = commands.first() else { panic!("{commands:?}") };
        assert_eq!(alarm.id, AlarmId::NotAutomatic);
        assert!(alarm.event.contains("it is in manual mode"), "{}", alarm.event);
        // The machine in manual mode is named, and beside it the grinder, which runs its job.
        let named = Device::BOTH.map(|other| alarm.event.contains(&other.to_string()));
        assert_eq!(named, Device::BOTH.map(|other| other == device || other == Device::Grinder), "{}", alarm.event);
        assert_eq!(commands.last(), Some(&Command::HoldMachine { device: Device::Grinder }));
        run.run_until(State::Held(Phase::Grind(JobStep::Run)));
        // Nobody goes on beside it.
        let commands = run.send(resume());
        assert!(
            matches!(&commands[..], [Command::Refuse { reason, .. }] if reason.contains("manual mode")),
            "{commands:?}"
        );
        run.send(Event::AutomaticAgain { device });
        assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Run)), "the key resumes nothing");
        run.send(resume());
        run.run_until(State::Complete);
    }
    // Found before a START: the machine is not even prepared.
    for (device, at) in
        [(Device::Cmm, JobStep::Send), (Device::Grinder, JobStep::Prepare), (Device::Cmm, JobStep::Prepare)]
    {
        let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
        run.start().run_until(State::Execute(Phase::Grind(at)));
        run.send(by_hand(device));
        run.run_to_rest();
        assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Send)), "{device} at {at:?}");
        assert_eq!((run.starts(), run.alarms()), (vec![], vec![AlarmId::NotAutomatic]));
        run.send(Event::AutomaticAgain { device });
        run.send(resume());
        run.run_until(State::Complete);
        assert_eq!(run.starts().len(), 2);
    }
    // While nothing moves a person may have it.
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Load));
    assert_eq!(run.send(by_hand(Device::Cmm)), []);
    assert_eq!(run.send(Event::AutomaticAgain { device: Device::Cmm }), []);
    run.run_until(State::Complete);
}

#[test]
fn manual_mode_holds_suspended_machine() {
    let (device, condition) = (Device::Grinder, Condition::Supplies);
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
    run.send(Event::ConditionLost { device, condition, message: "no air".into() });
    run.run_until(State::Suspended(Phase::Grind(JobStep::Run)));
    run.send(Event::NotAutomatic { device, message: "it is in manual mode".into() });
    run.send(Event::ConditionBack { device, condition });
    assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Run)));
}

#[test]
fn motion_of_idle_machine_holds_both() {
    let (moves, strays) = (Device::Grinder, Device::Cmm);
    let progress = Event::Progressed { device: strays, done: 3, total: 10 };
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Run)));
    let commands = run.send(progress.clone());
    assert_eq!(run.alarms(), [AlarmId::MovesUnasked]);
    assert_eq!(commands[1..], [Command::HoldMachine { device: strays }, Command::HoldMachine { device: moves }]);
    assert_eq!(run.cell.state(), State::Holding(Phase::Grind(JobStep::Run)));
    assert_eq!(run.send(progress.clone()), [], "told once");
    assert_eq!(run.send(Event::MachineHeld { device: strays }), []);
    assert_eq!(run.cell.state(), State::Holding(Phase::Grind(JobStep::Run)), "it is the other one that stands");
    run.send(Event::MachineHeld { device: moves });
    assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Run)));
    // It does not hold: only the safe sequence is left.
    let reason = "local".to_owned();
    let commands = run.send(Event::Refused { device: strays, request: MachineRequest::Hold, reason });
    assert!(commands.contains(&Command::AbortMachine { device: strays }), "{commands:?}");
    // Before the START of the other one.
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Prepare)));
    run.send(progress);
    run.run_to_rest();
    assert_eq!((run.cell.state(), run.starts()), (State::Held(Phase::Grind(JobStep::Send)), vec![]));
}

#[test]
fn progress_timeout_alarms_then_holds() {
    let device = Device::Grinder;
    let run_state = State::Execute(Phase::Grind(JobStep::Run));
    let due = |run: &TestRun<'_>| run.cell.next_deadline().unwrap() - run.now;
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(run_state);
    assert_eq!(due(&run), 30 * SECOND);
    run.now += 30 * SECOND;
    let commands = run.send(Event::Deadline);
    let Some(Command::Raise(alarm)) = commands.first() else { panic!("{commands:?}") };
    assert_eq!((alarm.id, commands.len()), (AlarmId::ProgressStands, 1));
    for piece in ["grinder", "for 30 s", "in 30 s"] {
        assert!(alarm.event.contains(piece), "{piece}: {}", alarm.event);
    }
    assert_eq!((run.cell.state(), due(&run)), (run_state, 30 * SECOND));
    // It goes on: the alarm goes away by itself.
    let progressed = |done| Event::Progressed { device, done, total: 1000 };
    assert_eq!(run.send(progressed(1)), [Command::Withdraw { alarm: AlarmId::ProgressStands }]);
    // A slow job is not slow again and again: three times its own pace is waited.
    run.now += 15 * SECOND;
    run.send(progressed(2));
    assert!((due(&run).as_secs_f64() - 45.0).abs() < 0.1, "{:?}", due(&run));
    run.now += 46 * SECOND;
    assert_eq!(run.send(Event::Deadline).len(), 1);
    run.now += 15 * SECOND;
    let commands = run.send(Event::Deadline);
    assert_eq!(run.alarms()[1..], [AlarmId::ProgressStands, AlarmId::NoAnswer]);
    assert_eq!(commands.last(), Some(&Command::HoldMachine { device }));
    // A machine that a person serves gives no signs.
    let deadlines = Deadlines { progress_notice: [None; 2], ..Deadlines::default() };
    let mut run = TestRun::new(CellPlan { deadlines, ..plan() }, |_| figures(5.0, 0.5));
    run.start().run_until(run_state);
    assert_eq!(due(&run), 60 * SECOND);
}

#[test]
fn wants_rejects_outdated_commands() {
    let device = Device::Grinder;
    let start = Command::StartMachine { device, cycle: 1 };
    let mut run = TestRun::new(plan(), |_| figures(5.0, 0.5));
    run.start().run_until(State::Execute(Phase::Grind(JobStep::Start)));
    assert!(run.cell.still_requires(&start) && !run.cell.still_requires(&Command::StartMachine { device, cycle: 2 }));
    run.send(hold());
    assert!(!run.cell.still_requires(&start), "held before it was given");
    run.open_commands.clear();
    run.send(Event::Refused { device, request: MachineRequest::Start, reason: "not given".into() });
    assert_eq!(run.cell.state(), State::Held(Phase::Grind(JobStep::Send)));
    run.send(resume());
    run.run_until(State::Execute(Phase::Grind(JobStep::Run)));
    run.send(hold());
    run.run_until(State::Held(Phase::Grind(JobStep::Run)));
    let go_on = Command::ResumeMachine { device };
    assert!(!run.cell.still_requires(&go_on));
    run.send(resume());
    assert!(run.cell.still_requires(&go_on));
    run.send(hold());
    assert!(!run.cell.still_requires(&go_on));
    run.send(abort());
    for command in [start, go_on, Command::Prepare { device, cycle: 1 }, Command::LoadPass { cycle: 1 }] {
        assert!(!run.cell.still_requires(&command), "{command:?} after an abort");
    }
    assert!(run.cell.still_requires(&Command::VerifyClear { device }));
}

/// Plays events chosen by chance, half of them the right answers, and returns the commands with what came before.
fn play_random_events(choices: &[(u16, bool, u8)]) -> Result<(), TestCaseError> {
    let mut run = TestRun::new(plan(), |cycle| figures(30.0 / f64::from(cycle), 6.0 / f64::from(cycle)));
    run.start();
    let mut excused = std::collections::BTreeMap::<Device, u32>::new();
    let mut seen = 0;
    // For each machine since its last start: it reported that it is clear, it reported that it cannot know this, and a
    // person confirmed it.
    let (mut clear, mut unknown, mut said) = ([false; 2], [false; 2], [false; 2]);
    let mut aborted = false;
    // Whether each machine was seen at its job since it was started last: nothing that it says then excuses a second
    // start.
    let mut begun = [false; 2];
    // Whether each machine was last seen at a stand.
    let mut stands = [true; 2];
    for (choice, good, wait) in choices {
        let before = run.cell.state();
        run.now += Duration::from_secs(u64::from(*wait));
        let event = if *good && !run.open_commands.is_empty() {
            let command = run.open_commands.remove(0);
            good_answer(&command, &mut run.figures)
        } else {
            let all = sample_events(run.cell.cycle());
            Some(all[usize::from(*choice) % all.len()].clone())
        };
        let Some(event) = event else { continue };
        match &event {
            Event::Cleared { device } => (clear[*device as usize], unknown[*device as usize]) = (true, false),
            Event::Obstructed { device, .. } | Event::LinkLost { device, .. } => clear[*device as usize] = false,
            Event::ClearUnknown { device } => (clear[*device as usize], unknown[*device as usize]) = (false, true),
            Event::ClearConfirmed { device, .. } => said[*device as usize] = true,
            Event::LoadConfirmed { .. } if before == State::Execute(Phase::Load) => said = [true; 2],
            Event::Reconciled { device, outcome: Reconciliation::NotStarted, .. }
            | Event::Refused { device, request: MachineRequest::Start, .. }
                if !begun[*device as usize] =>
            {
                *excused.entry(*device).or_default() += 1;
            }
            _ => {}
        }
        let restarted = matches!(event, Event::Restarted { .. });
        let told = event.clone();
        let commands = run.send(event);
        prop_assert!(!before.is_end() || commands.is_empty());
        if !commands.iter().any(|command| matches!(command, Command::Refuse { .. })) {
            match told {
                // One that no order of the cell has set going is told to hold, with an alarm; the cell is held all the
                // same.
                Event::Progressed { device, .. } if before.phase().and_then(Phase::moving_device) != Some(device) => {}
                Event::Started { device, .. }
                | Event::Progressed { device, .. }
                | Event::MachineResumed { device }
                | Event::Reconciled { device, outcome: Reconciliation::Running, .. } => {
                    (stands[device as usize], begun[device as usize]) = (false, true);
                }
                Event::MachineHeld { device }
                | Event::Ended { device, .. }
                | Event::DeclaredOver { device, .. }
                | Event::Refused { device, request: MachineRequest::Start, .. }
                | Event::Reconciled { device, .. } => stands[device as usize] = true,
                _ => {}
            }
        }
        // Held means still, or says which machine has not confirmed it.
        if let State::Held(phase) = run.cell.state() {
            let at = phase.job().map(|(device, _)| device).filter(|device| !stands[*device as usize]);
            prop_assert_eq!(run.cell.state().unconfirmed().or(at), run.cell.state().unconfirmed(), "{}", phase);
        }
        for command in &commands {
            if let Command::StartMachine { device, .. } = command {
                begun[*device as usize] = false;
                let other = device.other() as usize;
                prop_assert!(clear[other] || unknown[other] && said[other], "{device} started, the other not clear");
                (clear[*device as usize], said[*device as usize]) = (false, false);
            }
            let safe = !matches!(
                command.name().split(' ').next(),
                Some("abort_machine" | "verify_clear" | "raise" | "withdraw" | "refuse" | "finish" | "connect")
            );
            prop_assert!(!(aborted && safe), "{command:?} after an abort, restarted {restarted}");
        }
        aborted |= run.cell.state() == State::Aborting;
        seen += commands.len();
    }
    let mut count = std::collections::BTreeMap::<(Device, u32), u32>::new();
    for start in run.starts() {
        *count.entry(start).or_default() += 1;
    }
    for ((device, cycle), n) in count {
        let excuses = excused.get(&device).copied().unwrap_or(0);
        prop_assert!(n <= 1 + excuses, "{device} started {n} times for cycle {cycle} after {seen} commands");
    }
    // The faults stop, nobody answers: by its deadlines alone the cell comes to an end, or holds with an alarm, or
    // waits to be loaded.
    for _ in 0..12 {
        match run.cell.next_deadline() {
            Some(due) => {
                run.now = run.now.max(due);
                run.send(Event::Deadline);
            }
            None => break,
        }
    }
    let state = run.cell.state();
    let asks = matches!(
        state,
        State::Execute(Phase::Grind(JobStep::Clear) | Phase::Measure(JobStep::Clear) | Phase::Transfer)
    );
    let at_rest = asks || state.is_end() || matches!(state, State::Held(_) | State::Execute(Phase::Load));
    prop_assert!(at_rest && run.cell.next_deadline().is_none(), "hangs in {state}");
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn invariants_under_random_events(choices in prop::collection::vec((any::<u16>(), prop::bool::weighted(0.8), 0_u8..3), 0..120)) {
        play_random_events(&choices)?;
    }
}
