//! Grammar of the arguments of each command. A server refuses other arguments by error number; a client that follows
//! the grammar is not refused for its arguments.

use super::command::{DmeCommand, MAX_LINE_LENGTH};
use super::syntax::{Item, Reader, Strictness, SyntaxError, Tag, arguments, bad, has_stray_blank};

const PART_AXES: &[&str] = &["X", "Y", "Z", "R", "Tool.A", "Tool.B", "Tool.C"];
const CSYS: &[&str] = &["JogDisplayCsy", "JogMoveCsy", "MoveableMachineCsy", "MultipleArmCsy", "PartCsy", "SensorCsy"];
const COORDINATES: &[&str] = &["MachineCsy", "MoveableMachineCsy", "MultipleArmCsy", "PartCsy"];
const PARAMETERS: &[&str] = &["Accel", "Speed", "Approach", "Search", "Retract"];

/// Shape of the arguments of a command.
enum Shape {
    Nothing,
    /// Numbers: the allowed counts of arguments, and the conditions on single arguments.
    Numbers(&'static [usize], &'static [NumberCondition]),
    /// String.
    Text,
    /// Positive number.
    Positive,
    /// Whole number.
    Whole,
    /// Tag of an event command.
    Daemon,
    /// One of these names.
    OneOf(&'static [&'static str]),
    /// The frame and six numbers.
    Transformation,
    /// Requested properties, each once.
    Queries(&'static [&'static str]),
    /// Requested properties, with a time and a distance.
    Daemonised,
    /// Axes with values.
    Axes,
    /// Point to touch.
    Touch,
    /// Properties of tools: `Enumerated` lists the parts of one property, `ReadProperties` reads several properties,
    /// `Set` sets several.
    Enumerated,
    ReadProperties,
    Set,
}

/// Condition on one of the numbers, by index: `Positive`, or `PositiveWhole` (positive and whole).
enum NumberCondition {
    Positive(usize),
    PositiveWhole(usize),
}

use NumberCondition::{Positive as P, PositiveWhole as T};
use Shape::{
    Axes, Daemon, Daemonised, Enumerated, Nothing, Numbers, OneOf, Positive, Queries, ReadProperties, Set, Text, Touch,
    Transformation, Whole,
};

const COMMANDS: &[(&str, Shape)] = &[
    ("AbortE", Nothing),
    ("AlignPart", Numbers(&[7, 14], &[])),
    ("AlignTool", Numbers(&[4, 8], &[])),
    ("CenterPart", Numbers(&[4], &[])),
    ("ChangeTool", Text),
    ("ClearAllErrors", Nothing),
    ("DisableUser", Nothing),
    ("EnableUser", Nothing),
    ("EndSession", Nothing),
    ("EnumAllProp", Enumerated),
    ("EnumProp", Enumerated),
    ("EnumTools", Nothing),
    ("FindTool", Text),
    ("Get", Queries(PART_AXES)),
    ("GetChangeToolAction", Text),
    ("GetCoordSystem", Nothing),
    ("GetCsyTransformation", OneOf(CSYS)),
    ("GetDMEVersion", Nothing),
    ("GetErrStatusE", Nothing),
    ("GetErrorInfo", Whole),
    ("GetMachineClass", Nothing),
    ("GetProp", ReadProperties),
    ("GetPropE", ReadProperties),
    ("GetXtdErrStatus", Nothing),
    ("GoTo", Axes),
    ("Home", Nothing),
    ("IsHomed", Nothing),
    ("IsUserEnabled", Nothing),
    ("LockAxis", Queries(&["X", "Y", "Z", "R", "C", "Phi", "A", "B"])),
    ("OnMoveReportE", Daemonised),
    // The quality came with a later version than 1.4, the version of this grammar.
    ("OnPtMeasReport", Queries(&["X", "Y", "Z", "R", "Tool.A", "Tool.B", "Tool.C", "ER", "IJK"])),
    ("OnScanReport", Queries(&["X", "Y", "Z", "R", "Tool.A", "Tool.B", "Tool.C", "ER", "IJK", "Q"])),
    ("PtMeas", Touch),
    ("ReQualify", Nothing),
    ("ScanInCylEndIsPlane", Numbers(&[26], &[P(15), T(22)])),
    ("ScanInCylEndIsSphere", Numbers(&[23], &[P(15), P(19)])),
    ("ScanInPlaneEndIsCyl", Numbers(&[21], &[P(9), P(16), T(17)])),
    ("ScanInPlaneEndIsPlane", Numbers(&[20], &[P(9), T(16)])),
    ("ScanInPlaneEndIsSphere", Numbers(&[17], &[P(9), P(13)])),
    ("ScanOnCircle", Numbers(&[12], &[])),
    ("ScanOnCircleHint", Numbers(&[2], &[])),
    ("ScanOnLine", Numbers(&[10], &[P(9)])),
    ("ScanOnLineHint", Numbers(&[2], &[])),
    ("ScanUnknownHint", Positive),
    ("SetCoordSystem", OneOf(COORDINATES)),
    ("SetCsyTransformation", Transformation),
    ("SetProp", Set),
    ("SetTool", Text),
    ("StartSession", Nothing),
    ("StopAllDaemons", Nothing),
    ("StopDaemon", Daemon),
    ("TiltCenterPart", Numbers(&[7], &[])),
    ("TiltPart", Numbers(&[4], &[])),
];

/// Returns the names of all commands of I++ DME.
pub(super) fn names() -> impl Iterator<Item = &'static str> {
    COMMANDS.iter().map(|(name, _)| *name)
}

impl DmeCommand {
    /// Parses a command line from a client, as strictly as an I++ DME server must. `line` has no line end. Returns the
    /// tag and the command.
    ///
    /// # Errors
    /// Returns the I++ DME error number with which a server refuses the line, and the reason.
    pub fn read(line: &str) -> Result<(Tag, Self), SyntaxError> {
        if line.len() > MAX_LINE_LENGTH {
            return Err(SyntaxError { number: 8, reason: "a line of more than 65536 characters" });
        }
        if !line.bytes().all(|b| (32..=126).contains(&b)) {
            return Err(SyntaxError { number: 7, reason: "a character that is not ASCII 32 to 126" });
        }
        let (tag, rest) = tagged(line)?;
        if has_stray_blank(rest) {
            return Err(arguments("a blank that is not allowed"));
        }
        let mut reader = Reader::new(rest, Strictness::Strict);
        let command = Self::untagged(&mut reader)?;
        if !reader.is_at_end() {
            return Err(SyntaxError { number: 507, reason: "there is text after the command" });
        }
        if command.is_event() != matches!(tag, Tag::Event(_)) {
            return Err(SyntaxError { number: 1, reason: "only a command whose name ends in E has an event tag" });
        }
        check(&command)?;
        Ok((tag, command))
    }

    fn untagged(reader: &mut Reader<'_>) -> Result<Self, SyntaxError> {
        let illegal = |reason| SyntaxError { number: 507, reason };
        let text = reader.rest();
        let end = text.bytes().position(|b| !b.is_ascii_alphanumeric()).unwrap_or(text.len());
        let name = &text[..end];
        if !is_known(name) {
            return Err(illegal("an unknown command"));
        }
        *reader = Reader::new(&text[end..], Strictness::Strict);
        if !reader.eat('(') {
            return Err(arguments("a command without parentheses"));
        }
        Ok(Self::new(name, reader.in_parentheses()?))
    }
}

/// Returns true if I++ DME has a command of this name.
fn is_known(name: &str) -> bool {
    names().any(|known| known == name)
}

/// Checks that the arguments of `command` match the grammar of I++ DME: their number, their types and their names.
///
/// # Errors
/// Returns the error number with which a server refuses the command: 507 if the command is unknown, otherwise the
/// number for the invalid arguments.
fn check(command: &DmeCommand) -> Result<(), SyntaxError> {
    let Some((_, shape)) = COMMANDS.iter().find(|(name, _)| *name == command.name) else {
        return Err(SyntaxError { number: 507, reason: "an unknown command" });
    };
    let items = &command.arguments[..];
    let values_are_numbers = |item: &Item| match item {
        Item::Call(_, values) => values.iter().all(|value| value.number().is_some()),
        _ => true,
    };
    if !items.iter().all(values_are_numbers) {
        return Err(arguments("the parentheses of a property must contain numbers"));
    }
    let one = || match items {
        [] | [Item::Nothing] => Err(arguments("it has one argument")),
        [one] => Ok(one),
        _ => Err(arguments("it has one argument")),
    };
    match shape {
        Nothing if items.is_empty() => Ok(()),
        Nothing => Err(arguments("it has no arguments")),
        Text => matches!(one()?, Item::Text(_)).then_some(()).ok_or(bad("the argument is a string")),
        Daemon => matches!(one()?, Item::Tag(Tag::Event(_))).then_some(()).ok_or(bad("the argument is an event tag")),
        Positive => one()?.number().filter(|n| *n > 0.0).map(drop).ok_or(bad("the argument is a positive number")),
        Whole => one()?.number().filter(|n| n.fract() == 0.0).map(drop).ok_or(bad("the argument is a whole number")),
        OneOf(names) => match one()? {
            Item::Name(name) if names.contains(&name.as_str()) => Ok(()),
            _ => Err(arguments("the argument is not a name that this command allows")),
        },
        Numbers(counts, wanted) => numbers(items, counts, wanted),
        Transformation => transformation(items),
        Queries(names) => properties(items, &|name, values| names.contains(&name) && values.is_empty()),
        Daemonised => daemonised(items),
        Axes => properties(items, &|name, values| match name {
            "IJK" => values.len() == 3,
            _ => PART_AXES.contains(&name) && values.len() == 1,
        }),
        Touch => touch(items),
        Enumerated => one().and_then(|item| enumerated(item, items)).or_else(|flaw| trailing(items, flaw)),
        ReadProperties => each_property(items, check_read_property),
        Set => each_property(items, set),
    }
}

fn numbers(items: &[Item], counts: &[usize], wanted: &[NumberCondition]) -> Result<(), SyntaxError> {
    let numbers: Option<Vec<f64>> = items.iter().map(Item::number).collect();
    let numbers = numbers.filter(|numbers| counts.contains(&numbers.len()));
    let numbers = numbers.ok_or(arguments("the number of numbers is wrong"))?;
    for wanted in wanted {
        let (P(k) | T(k)) = wanted;
        if numbers[*k] <= 0.0 {
            return Err(bad("a step, a diameter and a number of crossings must be positive"));
        }
        if matches!(wanted, T(_)) && numbers[*k].fract() != 0.0 {
            return Err(bad("the number of crossings is whole"));
        }
    }
    Ok(())
}

fn transformation(items: &[Item]) -> Result<(), SyntaxError> {
    let [Item::Name(csy), rest @ ..] = items else { return Err(arguments("it has a name and six numbers")) };
    if rest.len() != 6 || rest.iter().any(|item| item.number().is_none()) {
        return Err(arguments("it has a name and six numbers"));
    }
    if !CSYS.contains(&csy.as_str()) {
        return Err(bad("the name is not the name of a coordinate system"));
    }
    match rest[3].number() {
        Some(theta) if (0.0..=180.0).contains(&theta) => Ok(()),
        _ => Err(SyntaxError { number: 1007, reason: "theta is 0 to 180 degrees" }),
    }
}

/// Checks that the arguments `items` of a command are properties. A property is a name with items in parentheses, for
/// example `X(1.5)`. `fits` receives the name of a property and the items in its parentheses. It returns true if the
/// command allows this property.
///
/// # Errors
/// Returns error 502 if `items` is empty, if an item is not a property, if `fits` returns false for an item, or if a
/// property occurs twice.
fn properties(items: &[Item], fits: &dyn Fn(&str, &[Item]) -> bool) -> Result<(), SyntaxError> {
    if items.is_empty() {
        return Err(arguments("it has at least one argument"));
    }
    for (k, item) in items.iter().enumerate() {
        let Item::Call(name, values) = item else { return Err(arguments("an argument is not a property")) };
        if !fits(name, values) {
            return Err(arguments("an argument is not a property that this command allows"));
        }
        once(&items[..k], name)?;
    }
    Ok(())
}

fn once(before: &[Item], name: &str) -> Result<(), SyntaxError> {
    let twice = before.iter().any(|item| matches!(item, Item::Call(other, _) if other == name));
    if twice { Err(arguments("a property occurs twice")) } else { Ok(()) }
}

fn daemonised(items: &[Item]) -> Result<(), SyntaxError> {
    if items.is_empty() {
        return Ok(());
    }
    for item in items {
        if matches!(item, Item::Call(name, values) if matches!(name.as_str(), "Time" | "Dis") && values.len() != 1) {
            return Err(bad("time and distance have a number"));
        }
    }
    properties(items, &|name, values| match name {
        "Time" | "Dis" => true,
        _ => PART_AXES.contains(&name) && values.is_empty(),
    })
}

fn touch(items: &[Item]) -> Result<(), SyntaxError> {
    for item in items {
        if matches!(item, Item::Call(name, values) if matches!(name.as_str(), "X" | "Y" | "Z") && values.is_empty()) {
            return Err(bad("a coordinate has a number"));
        }
    }
    properties(items, &|name, values| match name {
        "IJK" => values.len() == 3,
        _ => PART_AXES.contains(&name) && values.len() == 1,
    })?;
    let is_place = |item: &Item| matches!(item, Item::Call(name, _) if matches!(name.as_str(), "X" | "Y" | "Z"));
    if items.iter().any(is_place) { Ok(()) } else { Err(arguments("at least one of X, Y and Z is required")) }
}

// ---- properties of tools --------------------------------------------------------------------------------------------------------

/// Returns the error with which a server refuses the invalid arguments `items`. The result is always `Err`. If `items`
/// ends with a name and an empty item (as in `X,`), the error is 509: the name is a property whose parentheses are
/// missing. For all other `items`, the error is `otherwise`.
fn trailing(items: &[Item], otherwise: SyntaxError) -> Result<(), SyntaxError> {
    match items {
        [.., Item::Name(_), Item::Nothing] => Err(bad("a property ends with its parentheses")),
        _ => Err(otherwise),
    }
}

fn each_property(items: &[Item], check: fn(&[&str], &[Item]) -> Result<(), SyntaxError>) -> Result<(), SyntaxError> {
    let all_calls = !items.is_empty() && items.iter().all(|item| matches!(item, Item::Call(..)));
    if !all_calls {
        return trailing(items, arguments("an argument is not a property"));
    }
    for item in items {
        let Item::Call(name, values) = item else { continue };
        let parts: Vec<&str> = name.split('.').collect();
        check(&parts, values)?;
    }
    Ok(())
}

fn enumerated(item: &Item, items: &[Item]) -> Result<(), SyntaxError> {
    let Item::Call(name, values) = item else { return trailing(items, arguments("the argument is not a property")) };
    let parts: Vec<&str> = name.split('.').collect();
    if !values.is_empty() {
        return Err(arguments("the parentheses of a requested property must be empty"));
    }
    tool(&parts)?;
    if parts.len() > 1 && !matches!(parts[1], "GoToPar" | "PtMeasPar" | "ScanPar") {
        return Err(bad("the second part of the property name must be GoToPar, PtMeasPar or ScanPar"));
    }
    third_and_fourth(&parts, &["Act", "Def", "Max", "Min"])
}

fn tool(parts: &[&str]) -> Result<(), SyntaxError> {
    if matches!(parts[0], "Tool" | "FoundTool") {
        Ok(())
    } else {
        Err(bad("the first part of the property name must be Tool or FoundTool"))
    }
}

fn third_and_fourth(parts: &[&str], fourth: &[&str]) -> Result<(), SyntaxError> {
    if parts.get(2).is_some_and(|part| !PARAMETERS.contains(part)) {
        return Err(bad("the third part of the property name is not the name of a parameter"));
    }
    if parts.get(3).is_some_and(|part| !fourth.contains(part)) {
        return Err(bad("the fourth part of the property name is not allowed here; the part Act is allowed"));
    }
    if parts.len() > 4 { Err(arguments("the name of a property has at most four parts")) } else { Ok(()) }
}

fn check_read_property(parts: &[&str], values: &[Item]) -> Result<(), SyntaxError> {
    if !values.is_empty() {
        return Err(arguments("the parentheses of a requested property must be empty"));
    }
    tool(parts)?;
    match parts {
        [_] => {
            Err(arguments("the property name has only one part, the tool: add a second part, for example Tool.Name"))
        }
        ["FoundTool", "Alignment"] => {
            Err(arguments("FoundTool has no alignment: only the active tool (Tool) has an alignment"))
        }
        [
            _,
            "Alignment" | "CollisionVolume" | "Id" | "Name" | "AvrRadius" | "AvrOffsets" | "QualSigma" | "QualTime",
        ] => Ok(()),
        [_, "GoToPar" | "PtMeasPar" | "ScanPar", _, ..] => third_and_fourth(parts, &["Act", "Def", "Max", "Min"]),
        _ => Err(bad("the second part of the property name is not the name of a tool property")),
    }
}

fn set(parts: &[&str], values: &[Item]) -> Result<(), SyntaxError> {
    tool(parts)?;
    match parts {
        [_] | [_, _] => Err(arguments("the name of a property to set must have three or four parts")),
        [_, "GoToPar" | "PtMeasPar" | "ScanPar", _, ..] => third_and_fourth(parts, &["Act"]),
        _ => Err(bad("the second part of the property name must be GoToPar, PtMeasPar or ScanPar")),
    }?;
    match (values.len(), parts.len()) {
        (1, _) => Ok(()),
        (_, 4) => Err(bad("a property to set requires exactly one number")),
        _ => Err(arguments("a property to set requires exactly one number")),
    }
}

/// Splits `line` into the tag and the rest of the line. The tag has five characters, and one blank follows.
///
/// # Errors
/// Returns an error if the tag is invalid, if its number is 0, or if no blank follows the tag.
fn tagged(line: &str) -> Result<(Tag, &str), SyntaxError> {
    let illegal = SyntaxError { number: 1, reason: "an invalid tag" };
    let tag = line.get(..5).and_then(Tag::read).ok_or(illegal)?;
    if matches!(tag, Tag::Command(0) | Tag::Event(0)) {
        return Err(SyntaxError { number: 1, reason: "tags count from 1" });
    }
    let rest = line[5..].strip_prefix(' ').ok_or(SyntaxError { number: 2, reason: "no blank after the tag" })?;
    Ok((tag, rest))
}
