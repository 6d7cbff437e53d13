//! Texts of the workbench in all its languages.

// The texts themselves are in the files of the languages.
regrind_language::texts! {
    /// Text of the workbench.
    WorkbenchText in Workbench:
    NewRecipe NameOfRecipe NoRecipes OnlyEngineer NoFolder
    Version SavedBy LastRun InCycles NotSaved IsChanged OtherProgram
    Save Saved Simulate EndSimulation CompareWith PresentFile CloseComparison TakeText
    Editor EditorHelp NoProblem ProblemCount Checks DraftKept DiscardDraft
    Surface TargetsAndTracks Scallops Targets Tracks EveryNth WholeView SceneHelp NoPicture HeightsTimes
    Plan NoPlan NoAnswer Measuring TouchCount AtLeastMinutes Pass TrackCount Minutes AllPasses AtMostCycles ScallopHeight OfLimit
    WheelLoss Removed Budget Weak WeakRemedy Warning
    Simulation NotSimulated Seed Simulates SimulationFailed Accepted NotAccepted LastMap Report
    SimulationEnded SimulationReplaced OtherBrowser EarlierText BadSeed SignedOut PageGone DraftOfOldFile HasProblems Damaged NoDifference
    UnchangedLines Before After
}

#[cfg(test)]
mod tests {
    use super::*;
    use regrind_language::Language;

    #[test]
    fn texts_exist_in_every_language() {
        for text in WorkbenchText::ALL {
            for &language in Language::ALL {
                assert!(!text.to(language).trim().is_empty(), "{text:?} in {language:?}");
            }
        }
    }
}
