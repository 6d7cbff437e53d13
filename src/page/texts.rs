//! Texts of the page in all its languages. The texts of alarms are in a separate file. Messages of a cell about its
//! machines stay in the wording of the cell.

use regrind_cell::{Device, JobStep, Phase, StateName};
use regrind_control::NextStep;
use regrind_report::RunResult;

use super::users::PageRole;
use regrind_language::Language;

// The texts themselves are in the files of the languages.
regrind_language::texts! {
    /// Text of the page.
    Text in Page:
    // The frame of the page.
    Cell Runs Parts Recipes Machines Settings Components Record ShiftLog Events NewEntry AddEntry Time Who Kind What Older RecordIntact SignedUpTo NotSigned RecordBroken
    Compare Language Appearance AsTheSystem Light Dark HighContrast SkipToOrders Simulation
    NotConnected ProgramGone SimulationGone PageGone Plant Trend PlantGone
    // Texts about the part.
    Part Recipe Cycle OfAtMost Operator Run Began Ended Since Until Result Alarms
    // Steps of a cycle.
    LoadStep GrindStep MeasureStep RegisterStep JudgeStep CorrectStep StepsOfCycle ToEndOfStep HeldBy
    ReasonOfHold StateReason Answer
    // Column with the current work.
    NextAction PreliminaryPoints PreliminaryMeans Waits WhatToDo ClearedBy ByItself ByOperator ByEngineer
    NoAlarm SeenAlarm SeenBy NoAlarmRaised Raised Withdrawn StoodAtTheEnd
    // Figures.
    Convergence LastJudged Cycles ThisRun UncertaintyOfGauge LeftOut Judged Limit Forecast NotMeasured
    Uncertainty Report
    // The map.
    Map Relief Difference DifferenceOfRuns Sigma Points Scale ScaleOfFirst ScaleOfMap ScaleOfTolerance
    SignOfMap NoCycleBefore PreliminaryDots HeightFactor Sections SectionHelp SaveMap Deviations Histogram
    NoRelief MapHelp KnownTo Filtered Planned Touched
    // Orders.
    Hold Resume Stop Abort Loaded IsClear DeclareOver WhatYouSaw FirstThing TakeControl ControlElsewhere
    NoButtonStops
    // The machines.
    MachinesNotLive Probe Wheel StateOfMachine Link Answers NoAnswerYet NoAnswerSince LostLinks Automatic
    ClearOfPart Supplies Yes No NotReported NotStated AnswerTime Temperature CalibrationDue Overdue
    RadiusTolerance RadiusError ReportedByGrinder InRecipe RemovedVolume LargestDepth SpindleLoad Duration
    // The settings.
    ThisBrowser SettingsStay WithKey Role FolderOfRuns
    // The map, closer.
    ZoomIn ZoomOut WholePart WheelOnPath
    // Steps of a person at a machine.
    StepMeasure StepMoveProbeClear StepBeginPass StepEndPass StepHold StepStop StepAbort CheckFirst
    RightPartClean RightPartClamped WheelIsClear ProbeIsClear ProbeFits WheelFits RequiredPoints AtLeast
    PlanDigits ProbeRadius Program OwnProgram MapDigits WheelRadius Feed SparkOutPasses WhenMeasured
    WhenProbeClear WhenPassBegun WhenPassEnded WhenAtRest PassHasBegun JobIsDone IsAtRest MeasurementFile
    SendMeasurement
    // Next actions.
    DoStep Nothing Load SeeClear SeeToAlarm ClearAlarm ResumeOrStop SeeStands KeepAway EmergencyCircuit
    ReadReport
    // States, by PackML's names.
    Idle Starting Execute Holding Held Unholding Suspending Suspended Unsuspending Stopping Stopped Aborting
    Aborted Completing Complete
    // Phases.
    AtLoad AtGrind AtTransfer AtMeasure AtRegister AtJudge AtCompensate
    // First action of a resume.
    GoesOn Asks SendsAnew ReadsResult GivesBack AsksToLoad LeavesPart ComputesAnew
    // Results of runs.
    Open Live Accepted NotAccepted WasStopped WasAborted Recovery All Show TwoSideBySide KeyNeeded
    // Signing in.
    SignIn SignOut UserName Password SignInRefused TooManyTries WhoMakesUsers Viewer Quality OperatorRole
    Engineer NotHere
}

/// Returns the word for a state of the cell.
pub(crate) fn state(name: StateName) -> Text {
    match name {
        StateName::Idle => Text::Idle,
        StateName::Starting => Text::Starting,
        StateName::Execute => Text::Execute,
        StateName::Holding => Text::Holding,
        StateName::Held => Text::Held,
        StateName::Unholding => Text::Unholding,
        StateName::Suspending => Text::Suspending,
        StateName::Suspended => Text::Suspended,
        StateName::Unsuspending => Text::Unsuspending,
        StateName::Stopping => Text::Stopping,
        StateName::Stopped => Text::Stopped,
        StateName::Aborting => Text::Aborting,
        StateName::Aborted => Text::Aborted,
        StateName::Completing => Text::Completing,
        StateName::Complete => Text::Complete,
    }
}

/// Returns the words for a phase of a run.
pub(crate) fn phase(phase: Phase) -> Text {
    match phase {
        Phase::Load => Text::AtLoad,
        Phase::Grind(_) => Text::AtGrind,
        Phase::Transfer => Text::AtTransfer,
        Phase::Measure(_) => Text::AtMeasure,
        Phase::Register => Text::AtRegister,
        Phase::Judge => Text::AtJudge,
        Phase::Compensate => Text::AtCompensate,
    }
}

/// Returns the words for the result of a run.
pub(crate) fn result(result: RunResult) -> Text {
    match result {
        RunResult::Open => Text::Open,
        RunResult::Accepted => Text::Accepted,
        RunResult::NotAccepted => Text::NotAccepted,
        RunResult::Stopped => Text::WasStopped,
        RunResult::Aborted => Text::WasAborted,
        RunResult::Recovery => Text::Recovery,
    }
}

/// Returns the word for a role of a person.
pub(crate) fn role(role: PageRole) -> Text {
    match role {
        PageRole::Viewer => Text::Viewer,
        PageRole::Quality => Text::Quality,
        PageRole::Operator => Text::OperatorRole,
        PageRole::Engineer => Text::Engineer,
    }
}

/// Returns the sentence for what a person must do next, and the machine that this concerns, if any.
pub(crate) fn next(next: &NextStep, language: Language) -> (String, Option<Device>) {
    let (text, device) = match next {
        NextStep::Load => (Text::Load, None),
        NextStep::SeeClear { device } => (Text::SeeClear, Some(*device)),
        NextStep::AtMachine { device } => (Text::DoStep, Some(*device)),
        NextStep::Bring { what } => return (what.clone(), None),
        NextStep::SeeToAlarm => (Text::SeeToAlarm, None),
        NextStep::ClearAlarm => (Text::ClearAlarm, None),
        NextStep::ResumeOrStop => (Text::ResumeOrStop, None),
        NextStep::SeeWhetherItStands { device } => (Text::SeeStands, Some(*device)),
        NextStep::KeepAway => (Text::KeepAway, None),
        NextStep::EmergencyCircuit => (Text::EmergencyCircuit, None),
        NextStep::ReadReport => (Text::ReadReport, None),
        _ => (Text::Nothing, None),
    };
    (text.to(language).to_owned(), device)
}

/// Returns the sentence that tells what the cell does first when a run that is held in `phase` is resumed. Also returns
/// the machine that the sentence concerns, if there is one.
pub(crate) fn on_resume(phase: Phase) -> (Text, Option<Device>) {
    let Some((device, step)) = phase.job() else {
        let text = match phase {
            Phase::Load => Text::AsksToLoad,
            Phase::Transfer => Text::LeavesPart,
            _ => Text::ComputesAnew,
        };
        return (text, None);
    };
    let text = match step {
        JobStep::Run => Text::GoesOn,
        JobStep::Reconcile => Text::Asks,
        JobStep::Send | JobStep::Clear | JobStep::Prepare | JobStep::Start => Text::SendsAnew,
        JobStep::Collect | JobStep::Qualify => Text::ReadsResult,
        JobStep::Acknowledge | JobStep::Discard => Text::GivesBack,
    };
    (text, Some(device))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_exist_in_every_language() {
        for text in Text::ALL {
            for &language in Language::ALL {
                assert!(!text.to(language).trim().is_empty(), "{text:?} in {language:?}");
            }
        }
    }

    #[test]
    fn no_button_is_called_emergency_stop() {
        let buttons =
            [Text::Hold, Text::Resume, Text::Stop, Text::Abort, Text::Loaded, Text::IsClear, Text::DeclareOver];
        for text in buttons {
            for &language in Language::ALL {
                let word = text.to(language).to_lowercase();
                for bad in ["emergency", "not-halt", "notaus", "急停"] {
                    assert!(!word.contains(bad), "{word}");
                }
            }
        }
    }
}
