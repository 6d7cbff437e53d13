//! Texts of the report in all its languages. Sentences that the record has, such as the reason of a verdict, stay in the
//! words of the record.

use regrind_cell::{Alarm, Role, Verdict};
use regrind_language::Language;

// The texts themselves are in the files of the languages.
regrind_language::texts! {
    /// Text of the report.
    ReportText in Report:
    // The head.
    FormInspection Recovery Cycle CountOf Serial Drawing Material Accepted NotAccepted Stopped Aborted NotEnded
    MachinesHome MachinesNotHome
    // Judged figures.
    JudgedFigures MeasuredFigures Figure Result Uncertainty CredibleInterval Limit AgainstLimit InTolerance Decision
    NoLimit WithinLimit Undecided BeyondLimit AtMost AtLeast RuleWithUncertainty RuleWithoutUncertainty
    Definitions Definition RuleOfRejection PvOfPoints PvOfAperture
    // Maps and charts.
    ErrorOfForm HowItGotThere ScaleOfTolerance ScaleOfMap ScaleOfFirst SignOfMap MapsFiltered Sections SectionAlongX
    SectionAlongY Convergence Distribution Nodes ErrorAxis LimitOf
    // Verdicts on a cycle.
    Continue Accept MaxCycles BudgetSpent WrongResponse Diverging Stalled LeftOut
    // Who and with what.
    MadeBy Grinder MeasuringMachine Wheel Probe Operator Recipe Radius NotReported
    // The record.
    Record Run Began Ended NotYet Records Unbroken Closed NotClosed Signed NotSigned Alarms None Program
    MadeByDate CheckedByDate ReleasedByDate ApprovedByDate
    VerifyHint Page
    // Details.
    Cell Machines Cycles Points Outliers Coverage Level Judged
    OrdersAndConfirmations Raised Withdrawn NotWithdrawn ClearedBy NoAlarm NoOrder Given By Order
    Answer Identity HashOfLast Traceability NominalSurface
    Registration Fit Converged NotConverged Iterations PointsUsed PointsOffPart SurfaceCovered Repeatability
    FrameUncertainty Remarks Shift Rotation Locked NotOnRecord OtherPoses Budget Source ShareOfRms ShareOfPv
    NotStated Combined SquaresAddUp SourceScatter SourceForm SourcePose SourceRadius SourceScales SourceSquareness
    SourceProbe SourceTemperature SourceDatum FormOfSurface RawLastCycle Unit Meaning RawAsMeasured FormNote
    UnlessStated WavesLeftOut Iso10110 Raw LastPass SphereRadius Touches WholePatterns
    // A pass that broke off, measurements without figures, answers, and parameters of the machine.
    PassStopped PassAborted PassFailed PassWithoutEnd ShareGround ShareNotKnown RestUnchanged RecordIncomplete
    RunHasNotEnded NotJudged NotMeasured NoFigures ClearsItself ByOperator ByProcessEngineer AnswerAccepted
    AnswerRefused AnswerOnRecord ParametersOfMachine Parameter EstimatedError Compensated CorrectionOfNextPass
    ReducesRmsBy ErrorLeftForMap
    // Measuring strategy and Zernike coefficients.
    MeasuringStrategy TargetsAll TargetsChosen SpherePoints ProbingSpeed ApproachDistance
    PartTemperature Zernike ZernikeNote Residual CyclesOfTable
}

/// Returns the verdict on a cycle in words.
pub fn verdict_in_words(of: Verdict, language: Language) -> String {
    verdict(of).map_or_else(|| super::words::recorded_name(&of), |text| text.to(language).to_owned())
}

/// Returns the word for a verdict.
pub(super) fn verdict(verdict: Verdict) -> Option<ReportText> {
    Some(match verdict {
        Verdict::Accept => ReportText::Accept,
        Verdict::Continue => ReportText::Continue,
        Verdict::MaxCycles => ReportText::MaxCycles,
        Verdict::BudgetSpent => ReportText::BudgetSpent,
        Verdict::WrongResponse => ReportText::WrongResponse,
        Verdict::Diverging => ReportText::Diverging,
        Verdict::Stalled => ReportText::Stalled,
        Verdict::LeftOut => ReportText::LeftOut,
        Verdict::Undecided => ReportText::Undecided,
        _ => return None,
    })
}

/// Returns the word for the people who can clear an alarm.
pub(super) fn role(role: Role, language: Language) -> String {
    let text = match role {
        Role::Nobody => ReportText::ClearsItself,
        Role::Operator => ReportText::ByOperator,
        Role::ProcessEngineer => ReportText::ByProcessEngineer,
        role => return super::words::recorded_name(&role),
    };
    text.to(language).to_owned()
}

/// Returns the text of an alarm: its event with the values of the case, its consequence and its remedy. English texts
/// are those of the record; in other languages, the values of the case follow the general text.
pub(super) fn alarm(alarm: &Alarm, language: Language) -> String {
    let Some(entry) = language.alarm(alarm.id) else { return super::words::alarm_words(alarm) };
    let steps: Vec<String> = entry.remedy.iter().enumerate().map(|(k, step)| format!("{}. {step}", k + 1)).collect();
    format!("{} [{}] {} {}", entry.event, alarm.event, entry.consequence, steps.join(" "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_exist_in_every_language() {
        for text in ReportText::ALL {
            for &language in Language::ALL {
                assert!(!text.to(language).trim().is_empty(), "{text:?} in {language:?}");
            }
        }
    }
}
