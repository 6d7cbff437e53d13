//! Results as QIF 3.0 (ANSI/DMSC QIF 3.0, `QIFDocument.xsd`): a set of measurement results, one for each measurement of
//! the run.
//!
//! The figures are user-defined linear characteristics, because QIF has no characteristic for a peak to valley or a
//! root mean square along the normal. Its surface profile is a different figure (twice the largest deviation). Units:
//! millimetres. `combinedUncertainty` is the standard uncertainty, half of the expanded uncertainty that reports show.

use super::results::{Figure, LimitStatus, Measured, Results};
use super::xml::Xml;

/// Identifiers within the document. Those of figures and measurements continue from the last one.
const STANDARD: u32 = 1;
const PART: u32 = 2;
const SOFTWARE: u32 = 3;
const DEVICE: u32 = 4;
const COMPONENT: u32 = 5;
const FIRST_FIGURE: u32 = 6;

pub(super) fn text(results: &Results) -> String {
    let figures = results.kinds().count() as u32;
    let last =
        FIRST_FIGURE + 3 * figures + results.measured.iter().map(|of| 1 + of.figures.len() as u32).sum::<u32>() - 1;
    let mut xml = Xml::new();
    let root = [
        ("xmlns", "http://qifstandards.org/xsd/qif3"),
        ("xmlns:xsi", "http://www.w3.org/2001/XMLSchema-instance"),
        ("xsi:schemaLocation", "http://qifstandards.org/xsd/qif3 QIFDocument.xsd"),
        ("idMax", &last.to_string()),
        ("versionQIF", "3.0.0"),
    ];
    xml.within("QIFDocument", &root, |xml| {
        xml.text("QPId", &identity(&results.head, 0));
        xml.within("Version", &[], |xml| xml.text("TimeCreated", results.ended.as_ref().unwrap_or(&results.began)));
        header(xml, results);
        standard(xml);
        xml.within("SoftwareDefinitions", &[("n", "1")], |xml| software(xml, results));
        units(xml);
        resources(xml, results);
        product(xml, results);
        characteristics(xml, results);
        xml.within("Results", &[], |xml| measured(xml, results, FIRST_FIGURE + 3 * figures));
    });
    xml.end()
}

fn header(xml: &mut Xml, results: &Results) {
    let mark = if results.simulation { "SIMULATION. " } else { "" };
    xml.within("Header", &[], |xml| {
        xml.within("Application", &[], |xml| {
            xml.text("Name", &format!("Regrind {}", results.software));
        });
        xml.text(
            "Description",
            &format!("{mark}Run {}. {} Hash of the last record: {}", results.run, results.verdict, results.head),
        );
    });
}

fn standard(xml: &mut Xml) {
    xml.within("StandardsDefinitions", &[("n", "1")], |xml| {
        xml.within("Standard", &[("id", &STANDARD.to_string())], |xml| {
            xml.within("Organization", &[], |xml| xml.text("StandardsOrganizationEnum", "ISO"));
            xml.text("Designator", "14253-1");
            xml.text("Year", "2017");
        });
    });
}

fn software(xml: &mut Xml, results: &Results) {
    xml.within("Software", &[("id", &SOFTWARE.to_string())], |xml| {
        xml.text("VendorName", "Regrind");
        xml.text("ApplicationName", "regrind");
        xml.text("Version", &results.software);
    });
}

fn units(xml: &mut Xml) {
    xml.within("FileUnits", &[], |xml| {
        xml.within("PrimaryUnits", &[], |xml| {
            xml.within("LinearUnit", &[], |xml| {
                xml.text("SIUnitName", "meter");
                xml.text("UnitName", "mm");
                xml.within("UnitConversion", &[], |xml| xml.text("Factor", "0.001"));
            });
        });
    });
}

fn resources(xml: &mut Xml, results: &Results) {
    let [name, address] = results.cmm.clone().unwrap_or_else(|| ["not reported", "not reported"].map(str::to_owned));
    xml.within("MeasurementResources", &[], |xml| {
        xml.within("MeasurementDevices", &[("n", "1")], |xml| {
            xml.within("MeasurementDevice", &[("id", &DEVICE.to_string())], |xml| {
                xml.text("Name", &name);
                xml.text("Description", &format!("at {address}, station {}", results.station));
            });
        });
    });
}

fn product(xml: &mut Xml, results: &Results) {
    xml.within("Product", &[], |xml| {
        xml.within("PartSet", &[("n", "1")], |xml| {
            xml.within("Part", &[("id", &PART.to_string()), ("label", &results.name)], |xml| {
                attributes(
                    xml,
                    &[
                        ("name", &results.name),
                        ("recipe", &results.recipe[0]),
                        ("recipe_sha256", &results.recipe[1]),
                        ("cell", &results.cell[0]),
                        ("cell_sha256", &results.cell[1]),
                        ("decision_rule", results.decision_rule.as_deref().unwrap_or("not recorded")),
                    ],
                );
                xml.text("ModelNumber", &results.name);
            });
        });
    });
}

fn attributes(xml: &mut Xml, list: &[(&str, &str)]) {
    xml.within("Attributes", &[("n", &list.len().to_string())], |xml| {
        for (name, value) in list {
            xml.empty("AttributeStr", &[("name", name), ("value", value)]);
        }
    });
}

/// Writes the QIF element `Characteristics`. For each figure of the results, such as PV or RMS, `Characteristics`
/// contains three elements: a definition with the name and the limit, a nominal (the link to the definition), and an
/// item (the link to the nominal). The elements have consecutive identifiers. For the figure with the index k, counted
/// from 0, the definition has the identifier n = `FIRST_FIGURE + 3 k`, the nominal n + 1, and the item n + 2.
fn characteristics(xml: &mut Xml, results: &Results) {
    let kinds: Vec<_> = (FIRST_FIGURE..).step_by(3).zip(results.kinds()).collect();
    let n = kinds.len().to_string();
    let n = [("n", n.as_str())];
    xml.within("Characteristics", &[], |xml| {
        xml.text("FormalStandardId", &STANDARD.to_string());
        xml.within("CharacteristicDefinitions", &n, |xml| {
            for (id, kind) in &kinds {
                xml.within("UserDefinedLinearCharacteristicDefinition", &[("id", &id.to_string())], |xml| {
                    xml.text("Name", kind.name);
                    match kind.limit_mm {
                        Some(limit_mm) => xml.within("Tolerance", &[], |xml| {
                            xml.text("MaxValue", &mm(limit_mm));
                            xml.text("DefinedAsLimit", "true");
                        }),
                        None => xml.text("NonTolerance", "MEASURED"),
                    }
                    xml.text("WhatToMeasure", kind.what);
                });
            }
        });
        xml.within("CharacteristicNominals", &n, |xml| {
            for (id, kind) in &kinds {
                xml.within("UserDefinedLinearCharacteristicNominal", &[("id", &(id + 1).to_string())], |xml| {
                    xml.text("CharacteristicDefinitionId", &id.to_string());
                    xml.text("Name", kind.name);
                });
            }
        });
        xml.within("CharacteristicItems", &n, |xml| {
            for (id, kind) in &kinds {
                xml.within("UserDefinedLinearCharacteristicItem", &[("id", &(id + 2).to_string())], |xml| {
                    xml.text("Name", kind.name);
                    xml.text("CharacteristicNominalId", &(id + 1).to_string());
                });
            }
        });
    });
}

fn measured(xml: &mut Xml, results: &Results, first: u32) {
    xml.within("MeasurementResultsSet", &[("n", &results.measured.len().to_string())], |xml| {
        let mut id = first;
        for (number, of) in (1..).zip(&results.measured) {
            measurement(xml, results, number, of, id);
            id += 1 + of.figures.len() as u32;
        }
    });
    xml.within("ActualComponentSets", &[("n", "1")], |xml| {
        xml.within("ActualComponentSet", &[("n", "1")], |xml| {
            xml.within("ActualComponent", &[("id", &COMPONENT.to_string())], |xml| {
                xml.text("SerialNumber", &results.part);
                xml.within("Status", &[], |xml| {
                    let status = match results.accepted {
                        Some(true) => "PASS",
                        Some(false) => "FAIL",
                        None => "UNKNOWN",
                    };
                    xml.text("InspectionStatusEnum", status);
                });
            });
        });
    });
}

fn measurement(xml: &mut Xml, results: &Results, number: u32, of: &Measured, id: u32) {
    let cycle = of.cycle.to_string();
    let [points, outliers] = of.points.map_or(["-", "-"].map(str::to_owned), |both| both.map(|n| n.to_string()));
    let coverage = of.coverage.map_or("-".to_owned(), |share| format!("{share:.6}"));
    xml.within("MeasurementResults", &[("id", &id.to_string())], |xml| {
        attributes(
            xml,
            &[
                ("cycle", &cycle),
                ("judged", &of.verdict),
                ("reason", &of.reason),
                ("points_used", &points),
                ("outliers", &outliers),
                ("coverage", &coverage),
                ("coverage_factor_of_expanded_uncertainty", "2"),
            ],
        );
        xml.within("InspectionTraceability", &[], |xml| {
            xml.text("ReportNumber", &results.run);
            xml.text("InspectionEnd", &of.utc);
            xml.within("InspectionOperator", &[], |xml| xml.text("Name", &results.operator));
        });
        xml.text("ThisResultsInstanceQPId", &identity(&results.head, number));
        if !of.figures.is_empty() {
            xml.within("MeasuredCharacteristics", &[], |xml| {
                xml.within("CharacteristicMeasurements", &[("n", &of.figures.len().to_string())], |xml| {
                    for ((index, own), figure) in (FIRST_FIGURE + 2..).step_by(3).zip(id + 1..).zip(&of.figures) {
                        figure_of(xml, of, figure, own, index);
                    }
                });
            });
        }
        xml.within("InspectionStatus", &[], |xml| xml.text("InspectionStatusEnum", inspection_status(of)));
        xml.within("ActualComponentIds", &[("n", "1")], |xml| xml.text("Id", &COMPONENT.to_string()));
    });
}

fn figure_of(xml: &mut Xml, of: &Measured, figure: &Figure, id: u32, item: u32) {
    xml.within("UserDefinedLinearCharacteristicMeasurement", &[("id", &id.to_string())], |xml| {
        xml.within("Status", &[], |xml| {
            let status = match figure.standing {
                LimitStatus::Within => "PASS",
                LimitStatus::Beyond => "FAIL",
                LimitStatus::Undecided => "INDETERMINATE",
                LimitStatus::NotJudged => "NOT_ANALYZED",
            };
            xml.text("CharacteristicStatusEnum", status);
        });
        xml.text("CharacteristicItemId", &item.to_string());
        xml.text("TimeStamp", &of.utc);
        xml.text("ActualComponentId", &COMPONENT.to_string());
        xml.within("MeasurementDeviceIds", &[("n", "1")], |xml| xml.text("Id", &DEVICE.to_string()));
        xml.text_with("Value", &[("combinedUncertainty", &mm(figure.expanded_mm / 2.0))], &mm(figure.found_mm));
    });
}

fn inspection_status(of: &Measured) -> &'static str {
    match of.standing {
        _ if of.figures.is_empty() => "NOT_CALCULATED",
        LimitStatus::Within => "PASS",
        LimitStatus::Beyond => "FAIL",
        LimitStatus::Undecided | LimitStatus::NotJudged => "UNKNOWN",
    }
}

/// Formats a length in millimetres with nine decimals and without an exponent. The XML type `xs:decimal` does not allow
/// an exponent. The last decimal is a picometre.
fn mm(value: f64) -> String {
    format!("{value:.9}")
}

/// Returns a UUID (version 8) that is computed from `head` and `number`. `head` is the hash of the last record, in
/// hexadecimal digits. `number` is 0 for the document and at least 1 for its parts, so that each of them gets its own
/// UUID. The same arguments always give the same UUID.
fn identity(head: &str, number: u32) -> String {
    let hex: String = head.chars().filter(char::is_ascii_hexdigit).take(24).collect();
    let hex = format!("{hex:0<24}{number:08x}");
    format!("{}-{}-8{}-8{}-{}", &hex[..8], &hex[8..12], &hex[13..16], &hex[17..20], &hex[20..32])
}
