//! Lines of the NIST test suite: the good ones are parsed and written back, the bad ones are refused with the number
//! listed for them.

use std::path::PathBuf;

use regrind::device::ippdme::{DmeCommand, DmeResponse};
use regrind_testutils::data::data;

fn files(extension: &str) -> Vec<(String, String)> {
    let folder = data("nist-ippdme-testsuite").join("test_files");
    let mut paths: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.retain(|path| path.extension().is_some_and(|found| found == extension));
    paths.sort();
    let read = |path: PathBuf| {
        (
            path.file_stem().unwrap().to_string_lossy().into_owned(),
            String::from_utf8_lossy(&std::fs::read(path).unwrap()).into_owned(),
        )
    };
    paths.into_iter().map(read).collect()
}

/// Returns the strings of a file: a line of two backslashes represents the end of a line on the wire, a colon the end
/// of the file.
fn lines(text: &str) -> impl Iterator<Item = &str> {
    text.lines().map(|line| line.trim_end_matches('\r')).filter(|line| !matches!(*line, "\\\\" | ":" | ""))
}

/// Returns the refused lines, each with the number that is two lines below it.
fn refused(text: &str) -> Vec<(&str, u16)> {
    let lines: Vec<&str> = text.lines().map(|line| line.trim_end_matches('\r')).collect();
    let number = |line: &str| (line.trim().len() == 4).then(|| line.trim().parse().ok()).flatten();
    (2..lines.len()).filter_map(|k| number(lines[k]).map(|number| (lines[k - 2], number))).collect()
}

#[test]
#[ignore = "needs the real measurements that REGRIND_DATA names"]
fn vector_commands_round_trip() {
    let texts = files("txt");
    let (mut good, mut wrong) = (0, Vec::new());
    for (name, program) in files("prg") {
        let text = &texts.iter().find(|(other, _)| *other == name).map(|(_, text)| text.as_str()).unwrap_or_default();
        let bad =
            if matches!(name.as_str(), "parserCmdErrors" | "numbersErrorCmd") { refused(text) } else { Vec::new() };
        for line in lines(&program).filter(|line| !bad.iter().any(|(bad, _)| bad == line)) {
            match DmeCommand::read(line) {
                Ok((tag, command)) => {
                    let again = command.line(tag);
                    let whole = again.strip_suffix("\r\n").unwrap();
                    assert_eq!(DmeCommand::read(whole), Ok((tag, command)), "{line}");
                    good += 1;
                }
                // The angle is read already where it stands for the checker, which comes later.
                Err(flaw) if flaw.number == 1007 && name == "checkerCmdErrors" => {}
                Err(flaw) => wrong.push(format!("{name}: {line}: {flaw:?}")),
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(good > 1000, "{good}");
}

#[test]
#[ignore = "needs the real measurements that REGRIND_DATA names"]
fn vector_bad_commands_give_error_code() {
    let (mut seen, mut wrong) = (0, Vec::new());
    for (name, text) in
        files("txt").iter().filter(|(name, _)| matches!(name.as_str(), "parserCmdErrors" | "numbersErrorCmd"))
    {
        for (line, number) in refused(text) {
            seen += 1;
            let found = DmeCommand::read(line).map_err(|flaw| flaw.number);
            if found.as_ref().err() != Some(&number) {
                wrong.push(format!("{name}: {line}: {number}, and not {found:?}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(seen > 200, "{seen}");
}

#[test]
#[ignore = "needs the real measurements that REGRIND_DATA names"]
fn vector_responses_parse() {
    let (mut good, mut wrong) = (0, Vec::new());
    for (name, answers) in
        files("res").iter().filter(|(name, _)| !matches!(name.as_str(), "parserResErrors" | "numbersErrorRes"))
    {
        for line in lines(answers) {
            match DmeResponse::read(line) {
                Ok(_) => good += 1,
                Err(flaw) => wrong.push(format!("{name}: {line}: {flaw:?}")),
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(good > 1000, "{good}");
}

#[test]
#[ignore = "needs the real measurements that REGRIND_DATA names"]
fn vector_broken_numbers_refused() {
    for (_, answers) in files("res").iter().filter(|(name, _)| name == "numbersErrorRes") {
        // A number with more digits than the standard allows is still a number.
        let broken = lines(answers).filter(|line| !line.contains("12345678901234567"));
        for line in broken {
            assert!(DmeResponse::read(line).is_err(), "{line}");
        }
    }
}
