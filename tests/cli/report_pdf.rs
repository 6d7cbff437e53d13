//! PDF of a report and label of a part, read by foreign readers: qpdf, pikepdf, the programs of Poppler, and zbar.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

use crate::program::{changed, run, run_folders, small_recipe};

/// Makes the shipped part in simulation, and returns the folder of its run.
fn made_part(home: &Path) -> PathBuf {
    let recipe = changed("recipes/freeform-mirror.toml", &[("[simulation]", "[simulation]\nspeed = 1e5")]);
    fs::write(home.join("freeform-mirror.toml"), recipe).unwrap();
    let made = run(&["run", "freeform-mirror.toml", "--part", "SN-7", "--seed", "3"], home);
    assert_eq!(made.0, 0, "{made:?}");
    run_folders(&home.join("runs")).remove(0)
}

/// Runs a foreign program on a file, and returns what it prints.
fn foreign(program: &str, arguments: &[&str], file: &Path) -> String {
    let output = Command::new(program).args(arguments).arg(file).output().unwrap_or_else(|error| {
        panic!("{program}: {error}; the readers are in the Debian packages qpdf, poppler-utils, python3-pikepdf, librsvg2-bin and zbar-tools")
    });
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{program}: {said}{}", String::from_utf8_lossy(&output.stderr));
    said
}

/// Prints the text of each page as `pdftotext` finds it, with one blank for any white space.
fn pages(pdf: &Path) -> Vec<String> {
    let output = Command::new("pdftotext").args(["-layout", pdf.to_str().unwrap(), "-"]).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let pages = text.trim_end_matches('\u{c}').split('\u{c}');
    pages.map(|page| page.split_whitespace().collect::<Vec<_>>().join(" ")).collect()
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

/// Part, conformance and page count as pikepdf reads them.
const PIKEPDF: &str = "
import sys, pikepdf
with pikepdf.open(sys.argv[1]) as pdf:
    with pdf.open_metadata() as about:
        print(about['pdfaid:part'], about['pdfaid:conformance'], about['dc:title'])
    print(pdf.Root.OutputIntents[0].S, len(pdf.pages), pdf.check())
";

#[test]
fn shipped_part_has_four_pages_with_the_figures_of_the_results() {
    let home = tempfile::tempdir().unwrap();
    let folder = made_part(home.path());
    let run_name = folder.file_name().unwrap().to_str().unwrap();
    for paper in ["a4", "letter"] {
        let written = run(&["report", folder.to_str().unwrap(), "--pdf", "--paper", paper], home.path());
        assert!(written.0 == 0 && written.1.contains("report.pdf"), "{written:?}");
        let pdf = folder.join("report.pdf");
        foreign("qpdf", &["--check"], &pdf);
        let read = foreign("/usr/bin/python3", &["-c", PIKEPDF], &pdf);
        assert_eq!(read, format!("2 B free-form mirror, {run_name}\n/GTS_PDFA1 4 []\n"));
        let fonts = foreign("pdffonts", &[], &pdf);
        let embedded: Vec<&str> = fonts.lines().skip(2).collect();
        assert!(embedded.len() >= 2 && embedded.iter().all(|font| font.contains(" yes yes yes ")), "{fonts}");
        if Command::new("verapdf").arg("--version").output().is_ok() {
            let report = foreign("verapdf", &["--flavour", "2b", "--format", "text"], &pdf);
            assert!(report.starts_with("PASS"), "{report}");
        }
        assert_pages(&pages(&pdf), &folder);

        // The same record gives the same bytes, and `audit verify` remakes them.
        let first = fs::read(&pdf).unwrap();
        run(&["report", folder.to_str().unwrap(), "--pdf", "--paper", paper], home.path());
        assert!(fs::read(&pdf).unwrap() == first);
        let (code, said, _) = run(&["audit", "verify", folder.to_str().unwrap()], home.path());
        assert!(code == 0 && !said.contains("report.pdf"), "{said}");
    }
    // A PDF and a label are compared in their own language, whatever the language of the report beside them.
    run(&["report", folder.to_str().unwrap(), "--pdf", "--label", "--language", "de"], home.path());
    run(&["report", folder.to_str().unwrap()], home.path());
    let (_, said, _) = run(&["audit", "verify", folder.to_str().unwrap()], home.path());
    assert!(!said.contains("differs"), "{said}");
    let pdf = folder.join("report.pdf");
    let mut bytes = fs::read(&pdf).unwrap();
    bytes.push(b'\n');
    fs::write(&pdf, bytes).unwrap();
    let (_, said, _) = run(&["audit", "verify", folder.to_str().unwrap()], home.path());
    assert!(said.contains("report.pdf differs"), "{said}");
}

/// Checks the texts of the pages against the files of the results: verdict, judged figures, identity and the number of
/// the page, and the whole indication of ISO 10110.
fn assert_pages(pages: &[String], folder: &Path) {
    let result = json(&folder.join("result.json"));
    let cycles = result["cycles"].as_array().unwrap();
    let last = cycles.last().unwrap();
    let all = pages.join(" ");
    let run_name = folder.file_name().unwrap().to_str().unwrap();
    // On the first page, a long name is on two lines.
    let run_begin = &run_name[..run_name.len() - "-SIMULATION".len() - 17];
    for words in ["ACCEPTED", "SN-7", "FFM-102-062", "fused silica", "SIMULATION", run_begin] {
        assert!(pages[0].contains(words), "{words}: {}", pages[0]);
    }
    for cycle in cycles {
        for key in ["judged_pv_um", "judged_rms_um"] {
            let value = format!("{:.2}", cycle[key].as_f64().unwrap());
            assert!(pages[0].contains(&value), "{key} {value}: {}", pages[0]);
        }
    }
    let figures = json(&folder.join(format!("cycle-{}/figures.json", last["cycle"])));
    for indication in [&figures["form_iso_10110_5"], &figures["iso_10110_5"]["notation"]] {
        let indication = indication.as_str().unwrap();
        assert!(all.contains(indication), "{indication}: {all}");
    }
    // The table of the form is longer than its page, so its head is repeated.
    let is_head = |page: &&String| page.contains("figure cycle 1 cycle 2 raw, last cycle unit meaning");
    assert_eq!(pages.iter().filter(is_head).count(), 2, "{all}");
    // Lengths are in micrometres, with the sign of the unit.
    for unit in [" um ", " um,", " urad ", " nm ", " nm,"] {
        assert!(!all.contains(unit), "{unit:?}: {all}");
    }
    for (k, page) in pages.iter().enumerate() {
        assert!(page.contains(&format!("SN-7 \u{b7} SIMULATION \u{b7} page {} of {}", k + 1, pages.len())), "{page}");
    }
}

/// A logo as deep as it may be, each of its 63 patterns drawn within the one before it.
#[test]
fn deep_logo_is_drawn_or_refused() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e5).display().to_string();
    assert_eq!(run(&["run", &recipe], home.path()).0, 0);
    fs::write(home.path().join("shop.toml"), "name = \"Optics\"\nlogo = \"logo.svg\"\n").unwrap();
    let [open, close] = ["<g opacity=\".9\">".repeat(120), "</g>".repeat(120)];
    let code_of = |patterns: usize| {
        let pattern = |k: usize| {
            let next = k + 1;
            format!(
                "<pattern id=\"p{k}\" width=\"1\" height=\"1\">{open}<path d=\"M0 0h9v9z\" fill=\"url(#p{next})\"/>{close}</pattern>"
            )
        };
        let patterns: String = (0..patterns).map(pattern).collect();
        let svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"10\" height=\"10\">{patterns}<path d=\"M0 0h9v9z\" fill=\"url(#p0)\"/></svg>"
        );
        fs::write(home.path().join("logo.svg"), svg).unwrap();
        run(&["report", "--pdf", "--header", "shop.toml"], home.path()).0
    };
    assert_eq!([code_of(63), code_of(64)], [0, 2]);
}

/// Another program reads the code of the label, drawn as a printer with 300 dots an inch would print it.
#[test]
fn code_of_label_has_serial_run_and_head() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e5).display().to_string();
    assert_eq!(run(&["run", &recipe, "--part", "Linse Ø40/7"], home.path()).0, 0);
    assert_eq!(run(&["report", "--label"], home.path()).0, 0);
    let folder = run_folders(&home.path().join("runs")).remove(0);
    let printed = home.path().join("label.png");
    let out = printed.to_str().unwrap();
    foreign("rsvg-convert", &["--dpi-x", "300", "--dpi-y", "300", "--output", out], &folder.join("label.svg"));
    let read = foreign("zbarimg", &["--quiet", "--raw"], &printed);
    let (code, verified, _) = run(&["audit", "verify", "--json"], home.path());
    let head = serde_json::from_str::<Value>(&verified).unwrap()["head"].clone();
    let name = folder.file_name().unwrap().to_str().unwrap();
    assert_eq!((code, read), (0, format!("Linse Ø40/7\n{name}\n{}\n", head.as_str().unwrap())));
}

#[test]
fn chinese_report_names_missing_fonts_or_shows_them() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e5).display().to_string();
    assert_eq!(run(&["run", &recipe], home.path()).0, 0);
    let (code, said, errors) = run(&["report", "--language", "zh", "--pdf"], home.path());
    if code == 0 {
        let folder = run_folders(&home.path().join("runs")).remove(0);
        assert!(pages(&folder.join("report.pdf"))[0].contains("合格"), "{said}");
    } else {
        assert!(errors.contains("font"), "{errors}");
    }
}
