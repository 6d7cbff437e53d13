//! Transition table, computed by the state machine itself: every sample event is handled in every reachable state. So
//! the table shows the actual behaviour of the program.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::hash::Hash;
use std::time::Duration;

use regrind_figures::PartResponse;

use super::cell::Cell;
use super::command::{Command, format_label};
use super::event::{
    Actor, CompensationRefusal, CompensationSummary, Condition, ConnectionRefusal, Event, Figures, FurtherTouches,
    GateFailure, GateResult, JobResult, MachineRequest, Occupation, OutlierFigures, Reconciliation, RecordFailure,
};
use super::plan::{CellPlan, Deadlines, FirstStep, GateLimits, HoldOrStop, PvPoints, Tolerance};
use super::state::{Device, JobStep, Phase, State};

/// Version of the transition table. A run can be continued only by a program with the version that began the run. Every
/// change of a reaction requires a new version.
pub const TABLE_VERSION: u32 = 13;

/// Reaction to an event in a state.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct TransitionRow {
    /// State.
    pub state: State,
    /// Name of the event, with the machine that it comes from.
    pub event: String,
    /// Possible answers. There is more than one if the answer depends on the values of the event or on earlier events.
    pub answers: BTreeSet<Reaction>,
}

/// Name of the command that answers an event which does not fit.
const REFUSE: &str = "refuse";

/// Possible answer.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Reaction {
    /// Next state.
    pub next: State,
    /// Commands, by name.
    pub commands: Vec<String>,
}

/// Next state, and the labels of the commands.
type LabelledAnswer = (State, Vec<(&'static str, Option<Device>)>);

impl Reaction {
    fn from_labels((next, labels): LabelledAnswer) -> Self {
        Self { next, commands: labels.into_iter().map(format_label).collect() }
    }

    /// Returns true if this reaction refuses the event, that is, if its commands contain "refuse".
    pub fn is_refusal(&self) -> bool {
        self.commands.iter().any(|command| command == REFUSE)
    }
}

/// Returns the transition table of the cell: one row for each pair of a reachable state and a sample event. The rows
/// are sorted by state, then by the name of the event. The table is computed by handling every event in every reachable
/// state.
pub fn transition_table() -> Vec<TransitionRow> {
    let mut answers: HashMap<State, Vec<Vec<LabelledAnswer>>> = HashMap::new();
    let mut open: VecDeque<Cell> =
        [HoldOrStop::Hold, HoldOrStop::Stop].into_iter().map(|d| Cell::new(sample_plan(d))).collect();
    let (mut seen, mut sampled) = (HashSet::new(), HashMap::new());
    while let Some(cell) = open.pop_front() {
        let events: &Vec<Event> = sampled.entry(cell.cycle()).or_insert_with(|| sample_events(cell.cycle()));
        let answers = answers.entry(cell.state()).or_insert_with(|| vec![Vec::new(); events.len()]);
        // Late enough for every deadline.
        let now = cell.next_deadline().unwrap_or(Duration::ZERO);
        let mut next = cell.clone();
        for (event, answers) in events.iter().zip(answers) {
            let answered = next.apply_event(now, event);
            let state = next.state();
            let labels = || next.commands.iter().map(Command::label).chain(answered.is_err().then_some((REFUSE, None)));
            // Almost all of the millions of answers are already known.
            if !answers.iter().any(|(then, commands)| *then == state && commands.iter().copied().eq(labels())) {
                answers.push((state, labels().collect()));
            }
            next.commands.clear();
            // An event that does not fit at all has changed nothing: the next event gets the cell as it was.
            if answered != Err(None) {
                if seen.insert(behaviour_key(&next)) {
                    open.push_back(next);
                }
                next = cell.clone();
            }
        }
    }
    let names: Vec<String> = sample_events(0).iter().map(event_label).collect();
    let mut rows: BTreeMap<(State, &str), BTreeSet<Reaction>> = BTreeMap::new();
    for (state, answers) in answers {
        for (name, answers) in names.iter().zip(answers) {
            rows.entry((state, name)).or_default().extend(answers.into_iter().map(Reaction::from_labels));
        }
    }
    rows.into_iter()
        .map(|((state, event), answers)| TransitionRow { state, event: event.to_owned(), answers })
        .collect()
}

/// Returns a key for comparing cells: two cells with equal keys react in the same way to all sample events.
/// [`transition_table`] therefore examines only one of several cells with equal keys.
///
/// The key contains no times and no exact counts. A count is replaced by the fact that matters, for example whether the
/// maximum number of passes is reached.
fn behaviour_key(cell: &Cell) -> impl Eq + Hash + use<> {
    let known = cell.machines.map(|known| (known.ready, known.was_connected && known.abort_confirmed));
    let clear = cell.machines.map(|known| (known.clear, known.clear_confirmed, known.clear_requested));
    let memory = (
        cell.diverging_cycles.min(1),
        cell.abort_repeated,
        cell.previous.is_some(),
        cell.pass_count >= cell.plan.max_cycles,
    );
    let grinds = cell.state().phase().and_then(Phase::moving_device) == Some(Device::Grinder);
    let by_hand = cell.machines.iter().any(|known| known.manual);
    // Only a reconciliation reads it.
    let asked = cell.state().phase().and_then(Phase::job).filter(|(_, step)| *step == JobStep::Reconcile);
    let begun =
        asked.map(|(device, _)| (cell.job_observed[device as usize], cell.failure_series[device as usize].reported));
    let discarded = cell.state().phase().and_then(Phase::job).filter(|(_, step)| *step == JobStep::Discard);
    let keeps = discarded.is_some_and(|(device, _)| cell.acknowledge_refused[device as usize]);
    let memory = (
        memory,
        cell.hold_deadline.is_some(),
        grinds && cell.pass_record_doubted,
        cell.stall_notified,
        by_hand,
        begun,
        keeps,
    );
    (cell.state, known, clear, cell.suspension_causes.is_empty(), memory, cell.plan.on_stall == HoldOrStop::Hold)
}

fn event_label(event: &Event) -> String {
    match event.device() {
        Some(device) => format!("{} ({device})", event.name()),
        None => event.name().to_owned(),
    }
}

fn sample_plan(disposal: HoldOrStop) -> CellPlan {
    CellPlan {
        begin_with: FirstStep::Grind,
        max_cycles: 3,
        tolerance: Tolerance {
            pv_mm: 0.010,
            rms_mm: 0.002,
            with_uncertainty: false,
            probability: Tolerance::DEFAULT_PROBABILITY,
            pv_points: PvPoints::All,
        },
        stall_share: 0.05,
        stall_mm: 0.0,
        on_stall: disposal,
        on_divergence: disposal,
        on_refusal: disposal,
        gates: GateLimits {
            min_found_share: 0.9,
            min_coverage: 0.9,
            max_shift_mm: 1.0,
            max_rotation_rad: 0.1,
            max_radius_error_mm: Some(0.002),
        },
        removal_budget_mm: 1.0,
        min_depth_mm: 0.001,
        clear_at_start: disposal == HoldOrStop::Stop,
        // One of the two plans retries nothing, so that the table shows the reaction to a failure that recurs.
        deadlines: Deadlines {
            max_recurring_failures: if disposal == HoldOrStop::Stop { 1 } else { u32::MAX },
            recurring_failure_time: Duration::MAX,
            ..Deadlines::default()
        },
    }
}

/// Returns sample events of every kind, from which the transition table is computed. If a reaction of the cell depends
/// on a value in the event, there is a sample for each case. Events that contain a cycle number contain `cycle`.
pub fn sample_events(cycle: u32) -> Vec<Event> {
    let mut events = order_events();
    for device in Device::BOTH {
        events.extend(machine_events(device, cycle));
    }
    events.extend(computation_events(cycle));
    events.push(Event::RecordFailed { reason: RecordFailure::DiskFull(String::new()) });
    events.push(Event::RecordFailed { reason: RecordFailure::Unwritable(String::new()) });
    events.push(Event::NotOnRecord { command: Command::Acknowledge { device: Device::Cmm }.name() });
    events.push(Event::NotOnRecord { command: Command::ResumeMachine { device: Device::Cmm }.name() });
    events.push(Event::ControlLost { reason: String::new() });
    events.push(Event::ControlBack);
    events.push(Event::Deadline);
    events
}

fn order_events() -> Vec<Event> {
    let (actor, reason) = (Actor { name: "somebody".to_owned(), station: "console".to_owned() }, String::new());
    let evidence = String::new();
    vec![
        Event::Start { actor: actor.clone() },
        Event::LoadConfirmed { actor: actor.clone() },
        Event::Hold { actor: actor.clone(), reason: reason.clone() },
        Event::Resume { actor: actor.clone(), reason: reason.clone() },
        Event::Stop { actor: actor.clone(), reason: reason.clone() },
        Event::Abort { actor: actor.clone(), reason },
        Event::ClearConfirmed { actor: actor.clone(), device: Device::Cmm },
        Event::ClearConfirmed { actor: actor.clone(), device: Device::Grinder },
        Event::DeclaredOver { actor: actor.clone(), device: Device::Cmm, evidence: evidence.clone() },
        Event::DeclaredOver { actor: actor.clone(), device: Device::Grinder, evidence },
        Event::Restarted { actor },
    ]
}

fn machine_events(device: Device, cycle: u32) -> Vec<Event> {
    let text = String::new;
    let mut events = vec![
        Event::LinkLost { device, reason: text() },
        Event::LinkBack { device, boot_id: 1 },
        Event::LinkBack { device, boot_id: 2 },
        Event::StationFailed { device, reason: text() },
        Event::Prepared { device, cycle },
        Event::Started { device, cycle },
        Event::StartUnknown { device, cycle, reason: text() },
        Event::JobVanished { device, reason: text() },
        Event::Progressed { device, done: 1, total: 2 },
        Event::MachineHeld { device },
        Event::MachineResumed { device },
        Event::Cleared { device },
        Event::Obstructed { device, message: text() },
        Event::ClearUnknown { device },
        Event::Fault { device, code: 5, message: text() },
        Event::Acknowledged { device },
        Event::AbortConfirmed { device },
    ];
    for condition in [Condition::Supplies, Condition::Signals] {
        events.push(Event::ConditionLost { device, condition, message: text() });
        events.push(Event::ConditionBack { device, condition });
    }
    events.push(Event::NotAutomatic { device, message: text() });
    events.push(Event::AutomaticAgain { device });
    for occupation in [Occupation::Idle, Occupation::ToClear, Occupation::Busy(text())] {
        events.push(Event::Connected { device, boot_id: 1, simulated: true, occupation });
    }
    let unlike = [
        ConnectionRefusal::Unreachable(text()),
        ConnectionRefusal::WrongDevice(text()),
        ConnectionRefusal::WordOrder(text()),
    ];
    let more = [ConnectionRefusal::Inches, ConnectionRefusal::Owned(text()), ConnectionRefusal::AtAnotherJob(text())];
    for reason in unlike.into_iter().chain(more) {
        events.push(Event::NotConnected { device, reason });
    }
    for result in [JobResult::Complete, JobResult::Stopped, JobResult::Aborted, JobResult::Failed] {
        events.push(Event::Ended { device, cycle, result });
        events.push(Event::Reconciled { device, cycle, outcome: Reconciliation::Ended(result) });
    }
    let outcomes = [Reconciliation::Running, Reconciliation::Held, Reconciliation::NotStarted];
    for outcome in outcomes.into_iter().chain([Reconciliation::Unknown(text())]) {
        events.push(Event::Reconciled { device, cycle, outcome });
    }
    use MachineRequest::{Abort, Acknowledge, Clear, Collect, Discard, Hold, Load, Prepare, Resume, Start, Stop};
    for request in [Load, Prepare, Start, Hold, Resume, Stop, Abort, Clear, Collect, Acknowledge, Discard] {
        events.push(Event::Refused { device, request, reason: text() });
    }
    events
}

fn computation_events(cycle: u32) -> Vec<Event> {
    let text = String::new;
    let failures = [GateFailure::NoPart, GateFailure::Contacts, GateFailure::Inches, GateFailure::Coverage(text())];
    let more = [
        GateFailure::Foreign(text()),
        GateFailure::Broken(text()),
        GateFailure::Temperature(text()),
        GateFailure::Moved(text()),
    ];
    let gates = failures.into_iter().chain(more).map(GateResult::Failed).chain([GateResult::Passed]);
    let mut events: Vec<_> = gates.map(|gate| Event::Collected { cycle, targets: 100, found: 99, gate }).collect();
    events.push(Event::Collected { cycle, targets: 100, found: 10, gate: GateResult::Passed });
    events.push(Event::PassLoaded { cycle });
    events.push(Event::RecordDoubted { cycle, reason: text() });
    events.push(Event::PlanLoaded { cycle });
    for radius_error_mm in [0.0, 0.010, f64::NAN] {
        events.push(Event::Qualified { cycle, radius_error_mm });
    }
    events.extend(sample_figures().into_iter().map(|figures| Event::Registered { cycle, figures }));
    events.push(Event::RegistrationFailed { cycle, reason: text() });
    events.push(Event::NotSaved { cycle, reason: RecordFailure::DiskFull(text()) });
    let (max_mm, depth_mm, predicted_pv_mm) = (0.02, 0.03, 0.005);
    let summary =
        CompensationSummary { max_correction_mm: max_mm, depth_mm, predicted_pv_mm, ..CompensationSummary::default() };
    events.push(Event::Compensated { cycle, summary: summary.clone() });
    let asking = CompensationSummary { confirmations_required: vec![text()], ..summary };
    events.push(Event::Compensated { cycle, summary: asking });
    let refusals = [CompensationRefusal::BudgetSpent(text()), CompensationRefusal::WeakDirections(Vec::new())];
    for reason in refusals.into_iter().chain([CompensationRefusal::Failed(text())]) {
        events.push(Event::CompensationRefused { cycle, reason });
    }
    events
}

fn sample_figures() -> Vec<Figures> {
    let plain = Figures {
        pv_mm: 0.030,
        pv_998_mm: None,
        rms_mm: 0.006,
        form: None,
        pv_expanded_mm: 0.0005,
        rms_expanded_mm: 0.0001,
        coverage: 0.99,
        points: 99,
        outliers: 0,
        with_outliers: None,
        shift_mm: 0.1,
        rotation_rad: 0.01,
        weak_directions: Vec::new(),
        warnings: Vec::new(),
        response: None,
        forecast: None,
        removed_mm: Some(0.1),
        unstated: None,
        further_touches: None,
    };
    let left_out = |can_repeat| {
        let outliers = OutlierFigures { pv_mm: 0.050, rms_mm: 0.002, description: String::new(), can_repeat };
        Figures { pv_mm: 0.005, rms_mm: 0.001, with_outliers: Some(Box::new(outliers)), ..plain.clone() }
    };
    let mut all = vec![
        plain.clone(),
        Figures { pv_mm: 0.020, rms_mm: 0.004, ..plain.clone() },
        Figures { pv_mm: 0.060, ..plain.clone() },
        Figures { pv_mm: 0.005, rms_mm: 0.001, ..plain.clone() },
        left_out(false),
        left_out(true),
        Figures { coverage: 0.5, ..plain.clone() },
        Figures { shift_mm: 5.0, ..plain.clone() },
        Figures { rotation_rad: 3.0, ..plain.clone() },
        Figures { removed_mm: Some(2.0), ..plain.clone() },
        Figures {
            further_touches: Some(Box::new(FurtherTouches { target_count: 20, reason: String::new() })),
            coverage: 0.1,
            ..plain.clone()
        },
        Figures { pv_mm: f64::NAN, ..plain.clone() },
    ];
    for response in [
        PartResponse::Expected,
        PartResponse::SignFlipped,
        PartResponse::Mirrored,
        PartResponse::NoEffect,
        PartResponse::Doubled,
    ] {
        all.push(Figures { response: Some(response), ..plain.clone() });
    }
    all
}
