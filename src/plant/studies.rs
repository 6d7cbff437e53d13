//! Studies: simulated runs of a recipe, distributed to workers by leases as the parts of the queue are.

use std::collections::BTreeMap;
use std::time::Duration;

use serde_json::Value;
use tokio_postgres::types::ToSql;

use super::error::{PlantError, refused};
use super::link::DatabaseLink;

/// Duration of the lease of a job. A worker renews the lease while it makes the run, so the job of a worker that died is
/// free again after this time.
const LEASE: Duration = Duration::from_secs(60);
/// Time between two renewals of the lease of a job.
pub const RENEWAL: Duration = Duration::from_secs(15);

/// Recipe of a study.
#[derive(Clone, Debug, PartialEq)]
pub struct Study {
    /// Name of the study.
    pub name: String,
    /// Name of the recipe.
    pub recipe: String,
    /// Text of the recipe.
    pub text: String,
    /// Files that the recipe names, by their path in the recipe.
    pub files: BTreeMap<String, Vec<u8>>,
}

/// Run that a worker has leased.
#[derive(Clone, Debug, PartialEq)]
pub struct LeasedRun {
    /// Id of the study.
    pub study: i32,
    /// Number of the job in the study, from 1.
    pub number: i32,
    /// Keys of the recipe, with the values that they have in this job.
    pub varied: Value,
    /// Seed of the simulated part and run.
    pub seed: u64,
    lease: i32,
}

impl Study {
    /// Stores the study in the plant, with one job for each combination of an entry of `variations` and a seed of
    /// `seeds`. An entry of `variations` contains keys of the recipe with their values. Returns the number of jobs.
    ///
    /// # Errors
    /// Fails if a study of that name exists, if the database role has no right to create studies, or if the plant
    /// cannot be reached.
    pub async fn begin(&self, link: &DatabaseLink, variations: &[Value], seeds: &[u64]) -> Result<usize, PlantError> {
        let seeds: Vec<i64> = seeds.iter().map(|seed| seed.cast_signed()).collect();
        let names: Vec<&str> = self.files.keys().map(String::as_str).collect();
        let contents: Vec<&[u8]> = self.files.values().map(Vec::as_slice).collect();
        let varied: Vec<String> = variations.iter().map(Value::to_string).collect();
        let Self { name, recipe, text, .. } = self;
        let values: [&(dyn ToSql + Sync); 7] = [name, recipe, text, &names, &contents, &varied, &seeds];
        let asked = "SELECT new_study($1, $2, $3, $4, $5, $6::text[]::jsonb[], $7)";
        match link.client().query_one(asked, &values).await {
            Err(error) if error.code() == Some(&tokio_postgres::error::SqlState::UNIQUE_VIOLATION) => {
                let what = format!("a study {name:?} already exists; give this one another name");
                Err(PlantError::Recipe(what))
            }
            other => other.map(|_| seeds.len() * variations.len()).map_err(refused("the study")),
        }
    }

    /// Reads the recipe of the study to which `job` belongs, with the files that the recipe names. The field `name` of
    /// the result is the id of the study.
    ///
    /// # Errors
    /// Fails if this computer did not sign in as a worker, or if the plant cannot be reached.
    pub async fn read(link: &DatabaseLink, job: &LeasedRun) -> Result<Self, PlantError> {
        let text = "SELECT recipe, text, names, contents FROM study_recipe($1)";
        let row = link.client().query_one(text, &[&job.study]).await.map_err(refused("the recipe of a study"))?;
        let (names, contents): (Vec<String>, Vec<Vec<u8>>) = (row.get(2), row.get(3));
        Ok(Self {
            name: job.study.to_string(),
            recipe: row.get(0),
            text: row.get(1),
            files: names.into_iter().zip(contents).collect(),
        })
    }
}

impl LeasedRun {
    /// Leases the next free job, from the oldest study first, for one minute. A job whose lease has ended without a
    /// result is free again, up to three leases in total. Returns `None` if no job is free.
    ///
    /// # Errors
    /// Fails if this computer did not sign in as a worker, or if the plant cannot be reached.
    pub async fn lease_next(link: &DatabaseLink) -> Result<Option<Self>, PlantError> {
        let text = "SELECT study, job, lease, varied::text, seed FROM take_job($1)";
        let row = link.client().query_opt(text, &[&seconds()]).await.map_err(refused("a job"))?;
        Ok(row.map(|row| Self {
            study: row.get(0),
            number: row.get(1),
            lease: row.get(2),
            varied: serde_json::from_str(row.get(3)).unwrap_or_default(),
            seed: row.get::<_, i64>(4).cast_unsigned(),
        }))
    }

    /// Extends the lease, so that it ends one minute from now. Returns false if this lease of the job is no longer valid.
    ///
    /// # Errors
    /// Fails if the plant cannot be reached.
    pub async fn renew(&self, link: &DatabaseLink) -> Result<bool, PlantError> {
        let values: [&(dyn ToSql + Sync); 4] = [&self.study, &self.number, &self.lease, &seconds()];
        let row = link.client().query_one("SELECT renew_job($1, $2, $3, $4)", &values).await;
        Ok(row.map_err(refused("the lease of a job"))?.get(0))
    }

    /// Stores the result of this job in the plant. `result` is the result of the simulated run, or the reason why there
    /// is none. Returns true if the plant accepts the result. Returns false if this lease of the job is no longer
    /// valid, for example because another worker has leased the job.
    ///
    /// # Errors
    /// Fails if the plant cannot be reached.
    pub async fn finish(&self, link: &DatabaseLink, result: &Result<Value, String>) -> Result<bool, PlantError> {
        let told = match result {
            Ok(told) => told.to_string(),
            Err(reason) => serde_json::json!({ "error": reason }).to_string(),
        };
        let values: [&(dyn ToSql + Sync); 5] = [&self.study, &self.number, &self.lease, &result.is_err(), &told];
        let text = "SELECT finish_job($1, $2, $3, $4, $5::text::jsonb)";
        let row = link.client().query_one(text, &values).await.map_err(refused("the result of a job"))?;
        Ok(row.get(0))
    }
}

/// Returns the duration of a lease in seconds.
fn seconds() -> i32 {
    i32::try_from(LEASE.as_secs()).unwrap_or(i32::MAX)
}
