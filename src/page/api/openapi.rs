//! Description of the interface for programs in OpenAPI 3.1, made from the table of its endpoints and from the types of its
//! answers.

use schemars::SchemaGenerator;
use schemars::generate::SchemaSettings;
use serde_json::{Map, Value, json};

use super::endpoint::Endpoint;
use super::parameters::{Parameter, Place};
use crate::problem::{MEDIA_TYPE, ProblemDocument, ProblemKind};

/// Problems of every endpoint.
const OF_ALL: [ProblemKind; 6] = [
    ProblemKind::Parameter,
    ProblemKind::NoAccess,
    ProblemKind::NotAcceptable,
    ProblemKind::OtherHost,
    ProblemKind::TooManyTokens,
    ProblemKind::Fault,
];

const DESCRIPTION: &str = "Reads a grinding cell and its runs. It gives no orders: every method other than GET and HEAD is \
refused with the status 405. Each error is a problem document (RFC 9457) with the place, the value, the limit and the remedy. \
Unknown parameters are refused. Units are last in the names: um is micrometres, mm millimetres, s seconds. A number that is \
not known is null.";

/// Returns the description of `endpoints`. `version` is that of the program.
pub(super) fn document(endpoints: &[&'static Endpoint], version: &str) -> Value {
    let mut settings = SchemaSettings::draft2020_12().for_serialize();
    settings.definitions_path = "/components/schemas".into();
    settings.meta_schema = None;
    let mut schemas = settings.into_generator();
    let problem = schemas.subschema_for::<ProblemDocument>().to_value();
    let mut paths = Map::new();
    for endpoint in endpoints {
        paths.insert(endpoint.path.into(), json!({ "get": operation(endpoint, &mut schemas, &problem) }));
    }
    json!({
        "openapi": "3.1.0",
        "info": {
            "title": "Regrind",
            "version": version,
            "summary": "A grinding cell for other programs: state, runs, figures, maps, events and metrics.",
            "description": DESCRIPTION,
            "license": { "name": "MIT OR Apache-2.0", "identifier": "MIT OR Apache-2.0" },
        },
        "servers": [{ "url": "/" }],
        "security": [{ "token": [] }],
        "paths": paths,
        "components": {
            "schemas": schemas.take_definitions(true),
            "securitySchemes": {
                "token": {
                    "type": "http",
                    "scheme": "bearer",
                    "description": "Token of a program, by `regrind users token NAME`. On a page without a list of users, the key in its address. The session of a browser gives access too.",
                },
            },
        },
    })
}

fn operation(endpoint: &Endpoint, schemas: &mut SchemaGenerator, problem: &Value) -> Value {
    let schema = (endpoint.schema)(schemas);
    let content: Map<String, Value> =
        endpoint.media.iter().map(|media| ((*media).to_owned(), json!({ "schema": schema }))).collect();
    let mut answers = Map::new();
    answers.insert("200".into(), json!({ "description": endpoint.summary, "content": content }));
    for (status, meaning) in endpoint.empty {
        answers.insert(status.to_string(), json!({ "description": meaning }));
    }
    for kind in OF_ALL.iter().chain(endpoint.problems) {
        add_problem(&mut answers, *kind, problem);
    }
    json!({
        "operationId": endpoint.id,
        "summary": endpoint.summary,
        "description": endpoint.description,
        "parameters": endpoint.parameters.iter().map(parameter).collect::<Vec<_>>(),
        "responses": answers,
    })
}

/// Adds a problem to the answers of an operation. Problems with one status share an answer.
fn add_problem(answers: &mut Map<String, Value>, kind: ProblemKind, problem: &Value) {
    let answer = answers.entry(kind.status().as_str()).or_insert_with(|| {
        let mut answer = json!({ "description": "", "content": { MEDIA_TYPE: { "schema": problem } } });
        if let Some((name, value)) = kind.header() {
            let schema = json!({ "type": "string" });
            let name = name.as_str();
            answer["headers"] = json!({ name: { "required": true, "schema": schema, "example": value } });
        }
        answer
    });
    let before = answer["description"].as_str().unwrap_or_default();
    let description = if before.is_empty() { kind.title().to_owned() } else { format!("{before}; {}", kind.title()) };
    answer["description"] = description.into();
}

fn parameter(parameter: &Parameter) -> Value {
    let place = match parameter.place {
        Place::Path => "path",
        Place::Query => "query",
        Place::Header => "header",
    };
    let schema = parameter.kind.schema();
    let example = match (&schema["type"], parameter.example.parse::<u64>()) {
        (Value::String(kind), Ok(number)) if kind == "integer" => Value::from(number),
        _ => parameter.example.into(),
    };
    json!({
        "name": parameter.name,
        "in": place,
        "required": parameter.place == Place::Path,
        "description": parameter.description,
        "schema": schema,
        "example": example,
    })
}
