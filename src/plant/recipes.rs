//! Recipes in the plant: stored in versions, signed by two people, and pulled by the hash that was signed.
//!
//! The signed hash covers name, version, text and files together. An old recipe under a new name therefore has another
//! hash, which nobody has signed. The cell verifies hash and signatures with the keys in its own plant file, so a
//! changed database cannot make it grind another recipe.

use std::collections::{BTreeMap, BTreeSet};

use data_encoding::HEXLOWER;
use regrind_journal::{AuditKey, PublicKey, sha256_hex};
use tokio_postgres::types::ToSql;

use super::error::{PlantError, refused};
use super::link::DatabaseLink;
use super::settings::Approver;

/// Number of people who must sign a recipe.
pub const SIGNERS: usize = 2;

/// Recipe in the plant: its text, and the files that it names.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlantRecipe {
    /// Name of the recipe.
    pub name: String,
    /// Version, from 1.
    pub version: i32,
    /// Text of the recipe.
    pub text: String,
    /// Files that the recipe names, by their path in the recipe.
    pub files: BTreeMap<String, Vec<u8>>,
}

/// Signature of a person on a recipe.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Approval {
    /// Name of the person.
    pub person: String,
    /// Public half of the person's key.
    pub key: String,
    /// Signature, in hexadecimal digits.
    pub signature: String,
}

impl Approval {
    /// Returns true if the key made the signature for this person and the recipe with the hash `sha256`. This does not
    /// prove whose key it is: a cell knows that from its plant file.
    pub fn is_valid(&self, sha256: &str) -> bool {
        let key: Option<PublicKey> = self.key.parse().ok();
        key.is_some_and(|key| key.has_signed(words(sha256, &self.person).as_bytes(), &self.signature))
    }

    /// Reads the signatures on the recipe with the hash `sha256` from the plant, in the order of their times. The
    /// database role must be that of a planner or a reader.
    ///
    /// # Errors
    /// Fails if the plant cannot be reached or refuses the query.
    pub async fn of_recipe(link: &DatabaseLink, sha256: &str) -> Result<Vec<Self>, PlantError> {
        let bytes = HEXLOWER.decode(sha256.as_bytes()).unwrap_or_default();
        let text = "SELECT person, key, signature FROM approval WHERE recipe = $1 ORDER BY at, person";
        let rows = link.client().query(text, &[&bytes]).await.map_err(refused("the signatures of a recipe"))?;
        Ok(rows.iter().map(|row| Self { person: row.get(0), key: row.get(1), signature: row.get(2) }).collect())
    }
}

impl PlantRecipe {
    /// Checks that enough people have signed the recipe, with valid signatures, different names and different keys.
    ///
    /// # Errors
    /// Fails if too few have signed, or if the plant cannot be reached or refuses the query.
    pub async fn check_signatures(&self, link: &DatabaseLink) -> Result<(), PlantError> {
        let sha256 = self.sha256();
        let mut valid = Approval::of_recipe(link, &sha256).await?;
        let stored = valid.len();
        valid.retain(|approval| approval.is_valid(&sha256));
        let wrong = stored - valid.len();
        let names: BTreeSet<&str> = valid.iter().map(|approval| &approval.person[..]).collect();
        let keys: BTreeSet<&str> = valid.iter().map(|approval| &approval.key[..]).collect();
        let signers = names.len().min(keys.len());
        if signers >= SIGNERS {
            return Ok(());
        }
        let Self { name, version, .. } = self;
        let wrong = if wrong == 0 { String::new() } else { format!(", and {wrong} wrong") };
        Err(PlantError::Recipe(format!(
            "version {version} of {name} has {signers} of the {SIGNERS} required signatures{wrong}: regrind plant approve"
        )))
    }

    /// Returns the SHA-256 of the recipe in hexadecimal digits. This hash identifies the recipe, and people sign it. It
    /// is computed from these lines:
    ///
    /// - the text `regrind recipe 1`, which names the format;
    /// - the name of the recipe;
    /// - the version;
    /// - the SHA-256 of the recipe's text;
    /// - for each file, the SHA-256 of its content and its name.
    pub fn sha256(&self) -> String {
        let mut lines =
            format!("regrind recipe 1\n{}\n{}\n{}\n", self.name, self.version, sha256_hex(self.text.as_bytes()));
        for (name, content) in &self.files {
            lines += &format!("{} {name}\n", sha256_hex(content));
        }
        sha256_hex(lines.as_bytes())
    }

    /// Stores the recipe in the plant as the next version of its name. Also sets `self.version`. Returns the SHA-256 of
    /// the recipe in hexadecimal digits.
    ///
    /// # Errors
    /// Fails if a recipe with the same text and files is already stored, under this or another name. Fails if another
    /// person stored a version at the same time, if the database role has no right to store recipes, or if the plant
    /// cannot be reached.
    pub async fn propose(&mut self, link: &DatabaseLink) -> Result<String, PlantError> {
        let failed = refused("the recipe");
        let newest = "SELECT coalesce(max(version), 0) FROM recipe WHERE name = $1";
        let row = link.client().query_one(newest, &[&self.name]).await.map_err(&failed)?;
        self.version = row.get::<_, i32>(0) + 1;
        let names: Vec<&str> = self.files.keys().map(String::as_str).collect();
        let contents: Vec<&[u8]> = self.files.values().map(Vec::as_slice).collect();
        let values: [&(dyn ToSql + Sync); 5] = [&self.name, &self.version, &self.text, &names, &contents];
        let text = "SELECT sha256, refused FROM propose_recipe($1, $2, $3, $4, $5)";
        let row = link.client().query_one(text, &values).await.map_err(&failed)?;
        if let Some(reason) = row.get::<_, Option<String>>(1) {
            return Err(PlantError::Recipe(format!("{reason}; nothing was stored")));
        }
        Ok(HEXLOWER.encode(row.get(0)))
    }

    /// Reads the recipe with this `name` and `version` from the plant. If `version` is `None`, reads the newest version
    /// that is not withdrawn. The database role must be that of a planner or a reader.
    ///
    /// # Errors
    /// Fails if there is no such recipe, or if the plant cannot be reached or refuses the query.
    pub async fn find(link: &DatabaseLink, name: &str, version: Option<i32>) -> Result<Self, PlantError> {
        let text = "SELECT name, version, text, array(SELECT f.name FROM recipe_file f WHERE f.recipe = r.sha256 ORDER BY 1),
                array(SELECT f.content FROM recipe_file f WHERE f.recipe = r.sha256 ORDER BY f.name)
            FROM recipe r WHERE name = $1 AND (version = $2 OR $2 IS NULL AND withdrawn_at IS NULL) ORDER BY version DESC LIMIT 1";
        let row = link.client().query_opt(text, &[&name, &version]).await.map_err(refused("a recipe"))?;
        let none = || {
            let of = version.map_or(String::new(), |version| format!(" of version {version}"));
            PlantError::Recipe(format!("there is no recipe {name:?}{of}; `regrind plant recipes` lists them"))
        };
        let row = row.ok_or_else(none)?;
        let (names, contents): (Vec<String>, Vec<Vec<u8>>) = (row.get(3), row.get(4));
        Ok(Self {
            name: row.get(0),
            version: row.get(1),
            text: row.get(2),
            files: names.into_iter().zip(contents).collect(),
        })
    }

    /// Signs the recipe with `key` in the name of `person`, and stores the signature in the plant. If `is_replacing` is
    /// true, the signature replaces an earlier one of this key, whose name was wrong, and it is stored even if another
    /// key has signed for this person. A cell counts only the names and keys in its own plant file.
    ///
    /// # Errors
    /// Fails if this person has signed the recipe already, or if somebody has signed it with this key. Also fails if
    /// the database role has no right to sign, or if the plant cannot be reached.
    pub async fn approve(
        &self,
        link: &DatabaseLink,
        person: &str,
        key: &AuditKey,
        is_replacing: bool,
    ) -> Result<(), PlantError> {
        let sha256 = self.sha256();
        let signature = key.sign(words(&sha256, person).as_bytes());
        let (bytes, own) = (HEXLOWER.decode(sha256.as_bytes()).unwrap_or_default(), key.public().to_string());
        let values: [&(dyn ToSql + Sync); 5] = [&bytes, &person, &own, &signature, &is_replacing];
        let text = "SELECT person, key FROM sign_recipe($1, $2, $3, $4, $5)";
        let Some(row) = link.client().query_opt(text, &values).await.map_err(refused("the signature"))? else {
            return Ok(());
        };
        let (signer, by): (&str, &str) = (row.get(0), row.get(1));
        let Self { name, version, .. } = self;
        Err(PlantError::Recipe(match (signer == person, by == own) {
            (true, true) => {
                format!(
                    "version {version} of {name} is already signed by {person} with this key; another person must sign it"
                )
            }
            (_, true) => format!(
                "version {version} of {name} is already signed by {signer} with this key; if that name was wrong, replace \
                 the signature: --replace"
            ),
            (_, false) => format!(
                "version {version} of {name} is already signed by {person} with another key; another person must sign it, \
                 or, if that key is not the key of {person}: --replace"
            ),
        }))
    }

    /// Withdraws the version `version` of the recipe `name`: no cell begins a part by it any more. Removes the parts that
    /// wait for it from the queue, and returns their serial numbers. Returns `None` if there is no such recipe, or if it
    /// is withdrawn already. `reason` is the reason, which the plant stores.
    ///
    /// # Errors
    /// Fails if the database role has no right to withdraw recipes, or if the plant cannot be reached.
    pub async fn withdraw(
        link: &DatabaseLink,
        (name, version): (&str, i32),
        reason: &str,
    ) -> Result<Option<Vec<String>>, PlantError> {
        let row = link.client().query_one("SELECT withdraw_recipe($1, $2, $3)", &[&name, &version, &reason]).await;
        Ok(row.map_err(refused("the withdrawal"))?.get(0))
    }

    /// Fetches the recipe with the hash `sha256` from the plant and verifies it. `approvers` is the list of people and
    /// their public keys in the plant file of the cell. The recipe must have the hash `sha256`. At least two people
    /// from `approvers`, with different names and keys, must have signed it. Returns the recipe and the names of the
    /// people in `approvers` who signed it.
    ///
    /// # Errors
    /// Fails if there is no such recipe, if it was withdrawn, if it does not have the hash `sha256`, or if too few
    /// people have signed it. The plant receives a report of each of these faults. Also fails if the plant cannot be
    /// reached.
    pub async fn pull(
        link: &DatabaseLink,
        sha256: &str,
        approvers: &[Approver],
    ) -> Result<(Self, Vec<String>), PlantError> {
        let bytes = HEXLOWER.decode(sha256.as_bytes()).unwrap_or_default();
        let text = "SELECT name, version, text, names, contents, persons, keys, signatures FROM pull_recipe($1)";
        let row = link.client().query_opt(text, &[&bytes]).await.map_err(refused("a recipe"))?;
        let found = match &row {
            None => Err(format!("there is no recipe {sha256}, or it was withdrawn")),
            Some(row) => {
                let (names, contents): (Vec<String>, Vec<Vec<u8>>) = (row.get(3), row.get(4));
                let recipe = Self {
                    name: row.get(0),
                    version: row.get(1),
                    text: row.get(2),
                    files: names.into_iter().zip(contents).collect(),
                };
                let [persons, keys, signatures]: [Vec<String>; 3] = [row.get(5), row.get(6), row.get(7)];
                let of = persons.into_iter().zip(keys).zip(signatures);
                let approvals: Vec<Approval> =
                    of.map(|((person, key), signature)| Approval { person, key, signature }).collect();
                proven(recipe, sha256, &approvals, approvers)
            }
        };
        match found {
            Ok(found) => Ok(found),
            Err(what) => {
                let values: [&(dyn ToSql + Sync); 2] = [&"recipe refused", &what];
                let told = link.client().query_one("SELECT complain(NULL, $1, $2)", &values).await;
                told.map_err(refused("the report of a problem"))?;
                Err(PlantError::Recipe(what))
            }
        }
    }
}

/// Returns the text that `person` signs to approve the recipe with the hash `sha256`.
fn words(sha256: &str, person: &str) -> String {
    format!("regrind recipe approval 1\n{sha256}\n{person}\n")
}

/// Verifies a recipe from the plant. Its hash must be `sha256`. At least two people from `approvers`, with different
/// names and keys, must have a valid signature in `approvals`. Returns the recipe and the names of these people. If the
/// verification fails, returns the reason as a text.
fn proven(
    recipe: PlantRecipe,
    sha256: &str,
    approvals: &[Approval],
    approvers: &[Approver],
) -> Result<(PlantRecipe, Vec<String>), String> {
    let PlantRecipe { name, version, .. } = &recipe;
    if recipe.sha256() != sha256 {
        return Err(format!(
            "version {version} of {name} from the plant does not have the hash {sha256}: name, version, text or a \
             file was changed"
        ));
    }
    let has_signed = |approver: &&Approver| {
        approvals.iter().any(|of| of.person == approver.name && of.key == approver.key && of.is_valid(sha256))
    };
    let mut signed: Vec<&Approver> = approvers.iter().filter(has_signed).collect();
    // Two names with one key count as one person; so does one name with two keys.
    signed.sort_by(|a, b| a.key.cmp(&b.key));
    signed.dedup_by(|a, b| a.key == b.key);
    signed.sort_by(|a, b| a.name.cmp(&b.name));
    signed.dedup_by(|a, b| a.name == b.name);
    if signed.len() < SIGNERS {
        let by = signed.iter().map(|of| of.name.as_str()).collect::<Vec<_>>().join(", ");
        let by = if by.is_empty() { "none".to_owned() } else { by };
        return Err(format!(
            "version {version} of {name} is signed by {by} of the persons in this cell's plant file; two signatures \
             are required: regrind plant approve"
        ));
    }
    let signed = signed.into_iter().map(|of| of.name.clone()).collect();
    Ok((recipe, signed))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recipe() -> PlantRecipe {
        let files = BTreeMap::from([("a.csv".to_owned(), b"1,2\n".to_vec())]);
        PlantRecipe { name: "mirror".into(), version: 3, text: "[part]\n".into(), files }
    }

    fn signed(recipe: &PlantRecipe, people: &[(&str, &AuditKey)]) -> Vec<Approval> {
        let sha256 = recipe.sha256();
        let of = |(person, key): &(&str, &AuditKey)| Approval {
            person: (*person).into(),
            key: key.public().to_string(),
            signature: key.sign(words(&sha256, person).as_bytes()),
        };
        people.iter().map(of).collect()
    }

    fn approver(name: &str, key: &AuditKey) -> Approver {
        Approver { name: name.into(), key: key.public().to_string() }
    }

    #[test]
    fn recipe_sha256_of_its_lines() {
        let text = sha256_hex(b"[part]\n");
        let lines = format!("regrind recipe 1\nmirror\n3\n{text}\n{} a.csv\n", sha256_hex(b"1,2\n"));
        assert_eq!(recipe().sha256(), sha256_hex(lines.as_bytes()));
    }

    #[test]
    fn proven_requires_two_approvers() {
        let [ada, bob, eve] = [AuditKey::new(), AuditKey::new(), AuditKey::new()];
        let known = [approver("Ada", &ada), approver("Bob", &bob)];
        let good = recipe();
        let both = signed(&good, &[("Ada", &ada), ("Bob", &bob)]);
        let of = |recipe: &PlantRecipe, approvals: &[Approval], approvers: &[Approver]| {
            proven(recipe.clone(), &good.sha256(), approvals, approvers).map(|(_, signed)| signed)
        };
        assert_eq!(of(&good, &both, &known), Ok(vec!["Ada".to_owned(), "Bob".to_owned()]));
        // The old text under a new name, or with another file, has a hash that nobody signed.
        for other in [
            PlantRecipe { name: "panel".into(), ..good.clone() },
            PlantRecipe { version: 4, ..good.clone() },
            PlantRecipe { text: "[part]\n\n".into(), ..good.clone() },
            PlantRecipe { files: BTreeMap::new(), ..good.clone() },
        ] {
            assert!(of(&other, &both, &known).unwrap_err().contains("was changed"));
            // With its own hash it is consistent, but nobody has signed it.
            let own = proven(other.clone(), &other.sha256(), &both, &known).unwrap_err();
            assert!(own.contains("signed by none"), "{own}");
        }
        let too_few = [
            (signed(&good, &[("Ada", &ada)]), known.to_vec()),
            (signed(&good, &[("Ada", &ada), ("Eve", &eve)]), known.to_vec()),
            // Signed in another person's name.
            (signed(&good, &[("Ada", &ada), ("Bob", &eve)]), known.to_vec()),
            // One person with two keys, and two names with one.
            (signed(&good, &[("Ada", &ada), ("Ada", &bob)]), vec![approver("Ada", &ada), approver("Ada", &bob)]),
            (signed(&good, &[("Ada", &ada), ("Bob", &ada)]), vec![approver("Ada", &ada), approver("Bob", &ada)]),
            // The signature of one person under the name of the other.
            (
                vec![both[0].clone(), Approval { signature: both[0].signature.clone(), ..both[1].clone() }],
                known.to_vec(),
            ),
            (both.clone(), Vec::new()),
        ];
        for (approvals, approvers) in too_few {
            let signers = if approvers.is_empty() { "signed by none" } else { "signed by Ada " };
            assert!(of(&good, &approvals, &approvers).unwrap_err().contains(signers), "{approvals:?}");
        }
    }
}
