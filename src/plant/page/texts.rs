//! Texts of the page in all its languages. The texts themselves are in the files of the languages. Messages of a cell, of
//! a record and of the database stay in English, the language of the record.

use regrind_language::Language;

regrind_language::texts! {
    /// Text of the page of a plant.
    Text in Plant:
    Cells Machine Grinder Cmm State Any AnyCell Real Simulated Search More Maps LocalTime NotTold Judged Days
    NoCellEnrolled CountAlarm CountHeld CountWaiting CountRunning CountIdle CountSilent NeedsPerson NobodyNeeded
    MoreCells MarkedOnBoard OneAlarm ManyAlarms NoReportYet NoReportFor HeardAgo LastReport StateUnknown
    OfTheJob DoneOfTotal TimeLeft CycleOfAtMost PartsInDays DayOfParts AcceptedAtOnce AcceptedLater
    NotAcceptedAny DaysOfUtc EndedParts AcceptedParts Yield CyclesAPart CyclesInWords FirstPassYield NoPartEnded
    AllRecipes AllCells LoopIsNotFirstPass CyclesOfNewest FirstPassIs OnlyReal OnlySimulated ShowReal ShowSimulated Queue
    QueueIsEmpty ForCell Due Late MadeBy LeasedTo OpenWork TheFirst Incidents NoIncident OnlyShows AllParts
    BegunBetween Measured AtLast AtFirst OnePart CountParts OnlyNewest NoDate RecipesInChart TooFewForChart
    PreliminaryLimits LimitsAre TimesAre FalseAlarmsAre MeanOfChart UpperLimit LowerLimit Allowed MeanRange
    MovingRangeOf ControlLimits AboveTolerance CountOfAll ToleranceIsAbove RangesAbove NelsonsRules NoRuleBroken
    PointsNewest Rule1 Rule2 Rule3 Rule4 Rule5 Rule6 Rule7 Rule8 OneSided DistributionIs NormalDistribution
    LogNormalDistribution CapabilityTooFew CapabilityNoLimit CapabilitySeveralLimits CapabilityNoSpread
    CapabilityOtherDistribution CapabilityOneRecipe CapabilityOfLoop NotInControl CheckRules CellsCompared
    OfEachCellNewest RecipesCompared NoCellMadeSuch FurtherCells TestOfCells MedianPv PvFromTo DiffersFromOthers
    TooFewParts MoreThanChance NoMoreThanChance SerialBegins NoSerialBegins TickTwoToFour MapsSideBySide
    NewestFirst BySerialNewestFirst SerialNumber ResultAccepted ResultNotAccepted ResultStopped ResultAborted
    ResultOpen ErrorMap NoMapReported FirstAndLastMap CopyOfPlant AsReported CopyIsVerified Proven Unbroken
    NotProven ChainAndFiles CopyNotSigned SignedByUnknownKey SignedToEnd SignedInPart NoRecordedEnd
    ReportDiffers KeepAndCompare ResultsAsQif ResultsAsDfq NoCycleReported ExpectedPv UncertaintyIs JudgedAs
    OneScale SignOfMaps HashOfMaps NoMap MapMissing MapNotOnRecord MapNotArrived MapChanged DatabaseGone
    DatabaseRefused NotFound InvalidRequest CellsGoOn NoSuchRun NoRecordYet GiveNumber NameTheRuns
    NothingMeasured Alarms Began Cell Convergence Cycle Cycles Ended LastJudged Limit Operator Part Parts Plant
    Probe Recipe Report Result Run Show Since Trend Until Wheel Simulation
}

regrind_language::texts! {
    /// Text about the state of a cell, or the next action at it.
    CellText in Plant:
    AtIdle AtStarting Executing AtHolding AtHeld AtUnholding AtSuspending AtSuspended AtUnsuspending AtStopping
    AtStopped AtAborting AtAborted AtCompleting AtComplete Loading Grinding Transferring Measuring Evaluating
    NextLoad NextSeeClear NextAtMachine NextSeeToAlarm NextClearAlarm NextResumeOrStop NextSeeStands
    NextKeepAway NextEmergencyCircuit NextReadReport
}

/// Returns the word for the result of a run. A result that this program does not know is shown as it is.
pub(super) fn result_word(result: &str, language: Language) -> String {
    let text = match result {
        "accepted" => Text::ResultAccepted,
        "not accepted" => Text::ResultNotAccepted,
        "stopped" => Text::ResultStopped,
        "aborted" => Text::ResultAborted,
        "open" => Text::ResultOpen,
        other => return regrind_document::visible(other),
    };
    text.to(language).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_exist_in_every_language() {
        let texts =
            Text::ALL.iter().map(|text| (format!("{text:?}"), Language::ALL.iter().map(|l| text.to(*l)).collect()));
        let of_cells =
            CellText::ALL.iter().map(|text| (format!("{text:?}"), Language::ALL.iter().map(|l| text.to(*l)).collect()));
        for (name, texts) in texts.chain(of_cells) {
            let texts: Vec<&str> = texts;
            assert!(texts.iter().all(|text| !text.trim().is_empty()), "{name}: {texts:?}");
        }
    }
}
