//! `regrind plant propose|approve|withdraw|recipes`: the recipes of a plant, in versions that two people have signed.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use clap::Args;
use regrind::journal::{AuditKey, is_plain_path};
use regrind::recipe::Recipe;
use regrind_plant::{Approval, PlantError, PlantRecipe};
use serde_json::json;

use super::super::failure::Failure;
use super::super::words::counted;
use super::super::{Outcome, check, name};
use super::failure::PlantFailure;
use super::plant_file::{Where, open};

/// Propose a recipe to the plant, as the next version under its name
#[derive(Args, Debug)]
#[command(after_help = "\
The recipe is checked as with `regrind check`. The files that the recipe names are proposed together with the recipe.
These files must be in the folder of the recipe or below. Cells make no part by a recipe before two people have
signed the recipe.

Example:
  regrind plant propose recipes/freeform-mirror.toml --plant planner.toml

Exit codes: 0 proposed; 2 the recipe is invalid or exists already, or the database refuses the recipe; 3 the database
cannot be reached.")]
pub(super) struct ToPropose {
    /// Recipe of the part
    #[arg(value_name = "RECIPE")]
    recipe: PathBuf,
    /// Name in the plant; by default the name of the file
    #[arg(long, value_name = "NAME", value_parser = name)]
    name: Option<String>,
    #[command(flatten)]
    plant: Where,
}

/// Sign a recipe; cells make parts by it after two people have signed it
#[derive(Args, Debug)]
#[command(after_help = "\
The key belongs to one person (`regrind audit key --key FILE` creates one). The plant file of each cell has the
public half of the key in `[[approver]]`, with the name of the person. With this key the cell verifies the signature
itself. The signature covers one hash of name, version, text and files. A name that was typed wrongly costs no version: sign
again with the right one and --replace.

Example:
  regrind plant approve freeform-mirror --person \"A. Smith\" --key smith.key --plant planner.toml

Exit codes: 0 signed; 2 there is no such recipe, the person has signed the recipe already, or the database refuses the
signature; 3 the database cannot be reached.")]
pub(super) struct ToApprove {
    /// Name of the recipe in the plant
    #[arg(value_name = "NAME")]
    name: String,
    /// Version of the recipe; by default the newest
    #[arg(long, value_name = "N")]
    version: Option<i32>,
    /// Person who signs, with the name from the plant files
    #[arg(long, value_name = "NAME", value_parser = name)]
    person: String,
    /// File of the person's key
    #[arg(long, value_name = "FILE")]
    key: PathBuf,
    /// Print the recipe, and sign nothing
    #[arg(long)]
    look: bool,
    /// Replace the signature of this key, because its name was wrong
    #[arg(long, conflicts_with = "look")]
    replace: bool,
    #[command(flatten)]
    plant: Where,
}

/// Withdraw a recipe: cells start no further part by it
#[derive(Args, Debug)]
#[command(after_help = "\
The parts that wait for this version leave the queue, and the command lists them. The text can come back under the same
name, as the next version, which two people sign anew.

Example:
  regrind plant withdraw freeform-mirror --version 3 --reason \"wrong radius of the wheel\" --plant planner.toml

Exit codes: 0 withdrawn; 1 there is no such recipe, or the recipe was withdrawn before; 2 the database refuses the command;
3 the database cannot be reached.")]
pub(super) struct ToWithdraw {
    /// Name of the recipe in the plant
    #[arg(value_name = "NAME")]
    name: String,
    /// Version of the recipe
    #[arg(long, value_name = "N")]
    version: i32,
    /// Reason, for the record
    #[arg(long, alias = "why", value_name = "WORDS", value_parser = name)]
    reason: String,
    #[command(flatten)]
    plant: Where,
}

/// List the recipes and their signatures
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind plant recipes --plant planner.toml

Exit codes: 0 listed; 2 the database refuses the command; 3 the database cannot be reached.")]
pub(super) struct ToList {
    #[command(flatten)]
    plant: Where,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

pub(super) fn propose(arguments: &ToPropose) -> Result<Outcome, Failure> {
    let recipe = check::or_show(Recipe::read(&arguments.recipe))?;
    let config = arguments.plant.read()?;
    let named = || arguments.recipe.file_stem().map_or("recipe".into(), |stem| stem.to_string_lossy().into_owned());
    let mut brought = PlantRecipe {
        name: arguments.name.clone().unwrap_or_else(named),
        version: 1,
        text: recipe.text().to_owned(),
        files: files_of(&recipe)?,
    };
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let sha256 = brought.propose(&link).await?;
        let PlantRecipe { name, version, files, .. } = &brought;
        let files = match files.len() {
            0 => String::new(),
            n => format!(" with {}", super::super::words::counted(n, "file")),
        };
        super::super::print(&format!(
            "{name} version {version}{files}, sha256 {sha256}\nto be signed by two people: regrind plant approve {name}\n"
        ))?;
        Ok(Outcome::Accepted)
    })
}

/// Reads the files that a recipe names. Returns a map from the path of each file, relative to the folder of the recipe,
/// to the content. Returns an error if a file cannot be read or is outside the folder of the recipe.
pub(super) fn files_of(recipe: &Recipe) -> Result<BTreeMap<String, Vec<u8>>, Failure> {
    let folder = recipe.path().parent().unwrap_or(Path::new(""));
    let mut files = BTreeMap::new();
    for path in recipe.files() {
        let inside = path.strip_prefix(folder).ok().filter(|inside| is_below(inside)).and_then(Path::to_str);
        let Some(inside) = inside else {
            let what = format!(
                "the recipe {} names the file {}, which is outside of the folder of the recipe; move the file into this folder, because the plant copies the recipe and its files to other computers",
                recipe.path().display(),
                path.display()
            );
            return Err(PlantError::Recipe(what).into());
        };
        let content =
            std::fs::read(path).map_err(|source| PlantFailure::Unreadable { path: path.to_owned(), source })?;
        files.insert(inside.replace('\\', "/"), content);
    }
    Ok(files)
}

/// Returns true if `path` is a relative path that stays below its start folder, so that no part of the path is `..`.
/// Returns false for an empty or absolute path.
pub(super) fn is_below(path: &Path) -> bool {
    path.components().all(|part| matches!(part, Component::Normal(_))) && path.to_str().is_some_and(is_plain_path)
}

pub(super) fn approve(arguments: &ToApprove) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    let key = AuditKey::read(&arguments.key).map_err(Failure::Journal)?;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let recipe = PlantRecipe::find(&link, &arguments.name, arguments.version).await?;
        if arguments.look {
            super::super::print(&regrind::document::visible(&recipe.text))?;
            return Ok(Outcome::Accepted);
        }
        recipe.approve(&link, &arguments.person, &key, arguments.replace).await?;
        let (name, version) = (&recipe.name, recipe.version);
        super::super::print(&format!(
            "{} has signed version {version} of {name}, sha256 {}\n",
            arguments.person,
            recipe.sha256()
        ))?;
        Ok(Outcome::Accepted)
    })
}

pub(super) fn withdraw(arguments: &ToWithdraw) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    let ToWithdraw { name, version, reason, .. } = arguments;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        if let Some(serials) = PlantRecipe::withdraw(&link, (name, *version), reason).await? {
            let mut text = format!("version {version} of {name} is withdrawn\n");
            if !serials.is_empty() {
                let parts = counted(serials.len(), "part");
                text += &format!("{parts} left the queue; to queue them by another version: regrind plant queue\n");
            }
            serials.iter().for_each(|serial| text += &format!("  {serial}\n"));
            super::super::print(&regrind::document::visible(&text))?;
            return Ok(Outcome::Accepted);
        }
        super::super::print(&format!(
            "the recipe {name} has no version {version}, or this version was withdrawn before\n"
        ))?;
        Ok(Outcome::NotInTolerance)
    })
}

pub(super) fn list(arguments: &ToList) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let text = "SELECT name, version, encode(sha256, 'hex'), to_char(proposed_at, 'YYYY-MM-DD HH24:MI:SS'), proposed_by::text,
                withdrawn_why FROM recipe r ORDER BY name, version DESC";
        let found = link.query(text, &[]).await?;
        let mut told = Vec::new();
        let mut lines = String::new();
        for row in &found {
            let [name, sha256, at, by]: [&str; 4] = [row.get(0), row.get(2), row.get(3), row.get(4)];
            let (version, withdrawn): (i32, Option<&str>) = (row.get(1), row.get(5));
            let (signed, wrong): (Vec<Approval>, Vec<Approval>) =
                Approval::of_recipe(&link, sha256).await?.into_iter().partition(|approval| approval.is_valid(sha256));
            let [signed, wrong] =
                [signed, wrong].map(|all| all.into_iter().map(|of| of.person).collect::<Vec<String>>());
            told.push(json!({
                "name": name, "version": version, "sha256": sha256, "proposed_at": at, "proposed_by": by, "signed_by": signed,
                "wrong_signatures": wrong, "withdrawn": withdrawn,
            }));
            let mut state = match (withdrawn, signed.len()) {
                (Some(reason), _) => format!("withdrawn: {reason}"),
                (None, 0) => "not signed yet".to_owned(),
                (None, _) => format!("signed by {}", signed.join(", ")),
            };
            if !wrong.is_empty() {
                state += &format!("; WRONG SIGNATURE of {}", wrong.join(", "));
            }
            lines += &format!("{name:<24}  {version:>3}  {at}  {}  {state}\n", &sha256[..12]);
        }
        match arguments.json {
            true => super::super::print_json(&told)?,
            false => super::super::print(&regrind::document::visible(&lines))?,
        }
        Ok(Outcome::Accepted)
    })
}
