//! Languages of the page and of the report. Each language has one file in `languages/` with all its texts.
//!
//! ```text
//!  languages/en.toml --> Catalogue --> Language::text(section, name) --> an enum of the names, made by texts! --> page, report
//! ```

use std::collections::{BTreeMap, HashMap};
use std::fmt::Display;
use std::sync::LazyLock;

use regrind_cell::AlarmId;
use serde::Deserialize;

macro_rules! languages {
    ($($(#[$default:meta])? $id:ident $tag:literal)+) => {
        /// Language of a reader.
        #[expect(missing_docs, reason = "each is named by its tag")]
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
        pub enum Language {
            $($(#[$default])? $id,)+
        }

        impl Language {
            /// All languages.
            pub const ALL: &[Self] = &[$(Self::$id),+];

            /// Returns the language tag for HTML and browsers, such as `en`.
            pub fn tag(self) -> &'static str {
                [$($tag),+][self as usize]
            }

            fn catalogue(self) -> &'static Catalogue {
                static CATALOGUES: LazyLock<Vec<Catalogue>> = LazyLock::new(|| {
                    let files = [$(include_str!(concat!("languages/", $tag, ".toml"))),+];
                    files.into_iter().map(|text| Catalogue::read(text).unwrap_or_default()).collect()
                });
                &CATALOGUES[self as usize]
            }

            #[cfg(test)]
            fn file(self) -> &'static str {
                [$(include_str!(concat!("languages/", $tag, ".toml"))),+][self as usize]
            }
        }
    };
}

languages! {
    #[default]
    En "en"
    De "de"
    Zh "zh"
}

/// Section of the texts of a language.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Section {
    /// Texts of the page.
    Page,
    /// Texts of the report.
    Report,
    /// Texts of the page on which recipes are written.
    Workbench,
    /// Texts of the page of a plant. Those that it shares with the page of a cell are in that section.
    Plant,
}

/// Makes an enum of texts, with the section in which the files of the languages have them.
///
/// ```text
/// regrind_language::texts! { Text in Page: Cell Runs Parts }
/// Text::Cell.to(Language::De)
/// ```
#[macro_export]
macro_rules! texts {
    ($(#[$doc:meta])* $enum:ident in $section:ident: $($name:ident)+) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(crate) enum $enum {
            $($name,)+
        }

        impl $enum {
            #[cfg(test)]
            const ALL: &[Self] = &[$(Self::$name),+];

            /// Returns this text in `language`.
            pub(crate) fn to(self, language: $crate::Language) -> &'static str {
                language.text($crate::Section::$section, [$(stringify!($name)),+][self as usize])
            }
        }
    };
}

/// Texts of an alarm in a language other than English, the language of the record.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AlarmEntry {
    /// General description of the event. The values of the alarm follow it.
    pub event: String,
    /// Its consequence.
    pub consequence: String,
    /// Steps of the remedy, in this order.
    pub remedy: Vec<String>,
}

/// Texts of one language.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Catalogue {
    name: String,
    decimal_sign: String,
    /// Texts of the page. The keys have the names of the variants of `Text`.
    page: HashMap<String, String>,
    /// Texts of the report. The keys have the names of the variants of `ReportText`.
    #[serde(default)]
    report: HashMap<String, String>,
    /// Texts of the page on which recipes are written. The keys have the names of the variants of `WorkbenchText`.
    #[serde(default)]
    workbench: HashMap<String, String>,
    /// Texts of the page of a plant. The keys have the names of the variants of its `Text`.
    #[serde(default)]
    plant: HashMap<String, String>,
    #[serde(default)]
    alarms: BTreeMap<AlarmId, AlarmEntry>,
}

impl Catalogue {
    fn read(text: &str) -> Result<Self, toml::de::Error> {
        let mut catalogue: Self = toml::from_str(text)?;
        for section in [&mut catalogue.page, &mut catalogue.report, &mut catalogue.workbench, &mut catalogue.plant] {
            *section = section.drain().map(|(key, text)| (variant_name(&key), text)).collect();
        }
        Ok(catalogue)
    }
}

/// Returns the name of the variant for a key, such as `NotConnected` for `not_connected`.
fn variant_name(key: &str) -> String {
    let word = |word: &str| {
        let mut letters = word.chars();
        letters.next().map(|first| first.to_ascii_uppercase()).into_iter().chain(letters).collect::<String>()
    };
    key.split('_').map(word).collect()
}

impl Language {
    /// Returns the name of the language in the language itself.
    pub fn name(self) -> &'static str {
        &self.catalogue().name
    }

    /// Returns the text with the name `name`, such as `NotConnected`, in a section. Tests hold that every language has
    /// every text.
    pub fn text(self, section: Section, name: &str) -> &'static str {
        let catalogue = self.catalogue();
        let texts = match section {
            Section::Page => catalogue.page.get(name),
            Section::Report => catalogue.report.get(name),
            Section::Workbench => catalogue.workbench.get(name),
            Section::Plant => catalogue.plant.get(name).or_else(|| catalogue.page.get(name)),
        };
        texts.map_or("", String::as_str)
    }

    /// Returns the texts of an alarm. Returns `None` if the language has none: then the texts of the record are used.
    pub fn alarm(self, id: AlarmId) -> Option<&'static AlarmEntry> {
        self.catalogue().alarms.get(&id)
    }

    /// Returns the first language in `tags` that the page supports. `tags` is a list separated by commas, such as the
    /// value of the header `Accept-Language`. The order of the list decides; weights such as `q=0.5` are ignored.
    /// Returns `None` if the page supports none of the languages.
    pub fn first_of(tags: &str) -> Option<Self> {
        tags.split(',').find_map(|tag| {
            let primary = tag.trim().split(['-', ';', '_']).next()?.to_ascii_lowercase();
            Self::ALL.iter().copied().find(|language| language.tag() == primary)
        })
    }
}

/// Returns `text` with each place `{name}` replaced by the value of that name. A place without a value stays as it is, and
/// braces in a value are no places.
pub fn filled(text: &str, values: &[(&str, &dyn Display)]) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find('{') {
        let (before, from) = rest.split_at(at);
        out.push_str(before);
        let end = from.find('}').unwrap_or(0);
        match values.iter().find(|(name, _)| end > 0 && from[1..end] == **name) {
            Some((_, value)) => {
                out.push_str(&value.to_string());
                rest = &from[end + 1..];
            }
            None => {
                out.push('{');
                rest = &from[1..];
            }
        }
    }
    out + rest
}

/// Formats a number with the given number of decimals, and with the decimal sign of `language`.
pub fn decimal(value: f64, digits: usize, language: Language) -> String {
    format!("{value:.digits$}").replacen('.', &language.catalogue().decimal_sign, 1).replacen('-', "\u{2212}", 1)
}

/// Returns the text of a number that has a decimal point with the decimal sign of `language`.
pub fn localised(number: &str, language: Language) -> String {
    number.replacen('.', &language.catalogue().decimal_sign, 1)
}

/// Formats a number with all its decimals, and with the decimal sign of `language`.
pub fn shortest(value: f64, language: Language) -> String {
    value.to_string().replacen('.', &language.catalogue().decimal_sign, 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the names of the places for values in a text, sorted.
    fn places(text: &str) -> Vec<&str> {
        let mut places: Vec<&str> = text.split('{').skip(1).filter_map(|rest| Some(rest.split_once('}')?.0)).collect();
        places.sort_unstable();
        places
    }

    #[test]
    fn every_language_has_every_text() {
        let english = Catalogue::read(Language::En.file()).unwrap();
        for language in Language::ALL {
            let read = Catalogue::read(language.file()).unwrap_or_else(|error| panic!("{language:?}: {error}"));
            let sections =
                |of: &Catalogue| [of.page.clone(), of.report.clone(), of.workbench.clone(), of.plant.clone()];
            for (english, read) in sections(&english).iter().zip(&sections(&read)) {
                for (key, text) in english {
                    assert!(read.get(key).is_some_and(|text| !text.trim().is_empty()), "{language:?} has no {key}");
                    assert_eq!(places(&read[key]), places(text), "{language:?}: the places of {key}");
                }
                for key in read.keys() {
                    assert!(english.contains_key(key), "{language:?}: {key} is in no other language");
                }
            }
            assert!(!read.name.is_empty() && read.decimal_sign.chars().count() == 1, "{language:?}");
        }
    }

    #[test]
    fn keys_become_variant_names() {
        for (key, name) in [("cell", "Cell"), ("not_connected", "NotConnected"), ("", ""), ("a__b", "AB")] {
            assert_eq!(variant_name(key), name);
        }
    }

    #[test]
    fn values_fill_their_places() {
        let values: [(&str, &dyn Display); 2] = [("a", &"{b}"), ("b", &7)];
        assert_eq!(filled("{b} of {a}, {c} {", &values), "7 of {b}, {c} {");
        assert_eq!(filled("单元 {a}}", &values), "单元 {b}}");
        assert_eq!(filled("", &[]), "");
    }

    #[test]
    fn first_of_accept_language() {
        for (tags, expected) in [
            ("de-DE,de;q=0.9,en;q=0.8", Some(Language::De)),
            ("fr, zh-Hans-CN;q=0.8", Some(Language::Zh)),
            ("EN_us", Some(Language::En)),
            ("fr", None),
            ("", None),
            (";;,,-", None),
        ] {
            assert_eq!(Language::first_of(tags), expected, "{tags}");
        }
    }

    #[test]
    fn numbers_have_sign_of_language() {
        assert_eq!([decimal(1.25, 1, Language::De), decimal(-0.5, 2, Language::En)], ["1,2", "\u{2212}0.50"]);
        assert_eq!([localised("> 99.9 %", Language::De), localised("7", Language::De)], ["> 99,9 %", "7"]);
        assert_eq!([shortest(1e-3, Language::De), shortest(12.0, Language::De)], ["0,001", "12"]);
    }
}
