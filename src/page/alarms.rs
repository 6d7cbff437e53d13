//! Alarms of a cell in the languages of the page. The values of an alarm stay in the wording of the cell.

use std::borrow::Cow;

use regrind_cell::Alarm;

use regrind_language::{AlarmEntry, Language};

/// Texts of an alarm in one language.
pub(crate) struct AlarmTexts<'a> {
    /// Cause of the alarm, with its values.
    pub(crate) event: Cow<'a, str>,
    /// Consequence of the alarm.
    pub(crate) consequence: &'a str,
    /// Remedy, as steps in this order.
    pub(crate) remedy: Vec<&'a str>,
}

/// Returns the cause, the consequence and the remedy of `alarm` in `language`. The values at the end of the cause, such
/// as a name or a measured number, are not translated.
pub(crate) fn alarm_texts(alarm: &Alarm, language: Language) -> AlarmTexts<'_> {
    let Some(AlarmEntry { event, consequence, remedy }) = language.alarm(alarm.id) else {
        let remedy = alarm.remedy.iter().map(String::as_str).collect();
        return AlarmTexts { event: Cow::Borrowed(&alarm.event), consequence: &alarm.consequence, remedy };
    };
    let case = case(&alarm.event, alarm.id.head());
    let remedy = remedy.iter().map(String::as_str).collect();
    AlarmTexts { event: Cow::Owned(format!("{event}{case}")), consequence, remedy }
}

/// Returns the specific end of `what`, the cause of an alarm. A cause consists of a general text, a colon and the
/// values of this alarm. The result begins with this colon. It is "." if there are no values.
///
/// `head` is the general text that this version of the program uses. An older record can have another general text.
/// Therefore the function does not compare the two texts. It only uses the number of colons in `head` to find the end
/// of the general text in `what`.
fn case<'a>(what: &'a str, head: &str) -> &'a str {
    let colons = head.matches(": ").count();
    what.match_indices(": ").nth(colons).map_or(".", |(at, _)| &what[at..])
}

#[cfg(test)]
mod tests {
    use super::*;
    use regrind_cell::{AlarmId, Role};

    #[test]
    fn alarms_translated_in_every_language() {
        for &id in AlarmId::ALL {
            let remedy = id.remedy().iter().map(|line| (*line).to_owned()).collect::<Vec<_>>();
            let event = format!("{}: grinder at 12 mm.", id.head());
            let alarm = Alarm { id, event, consequence: "c".to_owned(), remedy, cleared_by: Role::Operator };
            for language in [Language::De, Language::Zh] {
                let said = alarm_texts(&alarm, language);
                assert!(said.event.ends_with(": grinder at 12 mm."), "{id:?}: {}", said.event);
                assert!(!said.event.starts_with(id.head()), "{id:?} is not translated");
                assert_eq!(said.remedy.len(), alarm.remedy.len(), "{id:?} in {language:?}");
            }
            assert_eq!(alarm_texts(&alarm, Language::En).event, alarm.event);
            let older = id.head().replace(|letter: char| letter.is_alphabetic(), "#");
            let older = Alarm { event: format!("{older}: grinder at 12 mm."), ..alarm };
            assert!(
                alarm_texts(&older, Language::De).event.ends_with(": grinder at 12 mm."),
                "{id:?}: its older wording"
            );
            assert!(!alarm_texts(&older, Language::De).event.contains('#'), "{id:?}: its older wording");
        }
    }
}
