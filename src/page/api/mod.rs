//! Interface for programs: the cell, its runs, figures, maps and records as JSON, their events as a stream, and metrics. It
//! only reads.
//!
//! ```text
//!  request -> program_access (token, session) -> endpoint (Accept, parameters) -> runs, maps, stream, metrics -> JSON, text
//!                                                    ENDPOINTS, content ----------> openapi
//! ```

mod content;
mod endpoint;
mod exposition;
mod maps;
mod media;
mod metrics;
mod openapi;
mod parameters;
mod runs;
mod stream;

use std::sync::Arc;

use axum::Router;
use axum::middleware::from_fn_with_state;
use axum::response::Response;
use axum::routing::any;
use schemars::{JsonSchema, SchemaGenerator};
use serde_json::{Value, json};

use content::{
    CellNow, EndOfRecord, EventsPage, MapGrid, Outcome, RecordedEvent, RunDetail, RunFigures, RunMaps, RunState,
    RunsPage,
};
use endpoint::{Call, Endpoint, to_json, unknown_address, unless_known};
use parameters::{CYCLE, Kind, MAX_EXACT, Parameter, Place, RUN};

use crate::problem::{Problem, ProblemDocument, ProblemKind};
use crate::program_access::let_in;
use crate::shared::Shared;

/// Maximum and default number of runs, and of records, in an answer.
const RUNS_AT_ONCE: [u64; 2] = [500, 50];
const RECORDS_AT_ONCE: [u64; 2] = [1000, 100];

const JSON: &[&str] = &["application/json"];
const NOT_MODIFIED: (u16, &str) = (304, "The client has this version already, by its header If-None-Match.");

const LIMIT_OF_RUNS: Parameter = Parameter {
    name: "limit",
    place: Place::Query,
    kind: Kind::Number { min: 1, max: RUNS_AT_ONCE[0], default: Some(RUNS_AT_ONCE[1]) },
    description: "Maximum number of runs in the answer.",
    example: "50",
};
const CURSOR: Parameter = Parameter {
    name: "cursor",
    place: Place::Query,
    kind: Kind::Cursor,
    description: "Position after which the page begins: the next_cursor of an earlier answer.",
    example: "2026-07-04T12:00:00.000Z~freeform-mirror-20260704T120000Z-SIMULATION",
};
const PART: Parameter = Parameter {
    name: "part",
    place: Place::Query,
    kind: Kind::Text { max: 255 },
    description: "Only runs of the part with this serial number.",
    example: "SN-0042",
};
const RESULT: Parameter = Parameter {
    name: "result",
    place: Place::Query,
    kind: Kind::Words(&Outcome::NAMES),
    description: "Only runs with this result.",
    example: "accepted",
};
const AFTER: Parameter = Parameter {
    name: "after",
    place: Place::Query,
    kind: Kind::Number { min: 0, max: MAX_EXACT, default: Some(0) },
    description: "Number of the record after which the page begins.",
    example: "0",
};
const LIMIT_OF_RECORDS: Parameter = Parameter {
    name: "limit",
    place: Place::Query,
    kind: Kind::Number { min: 1, max: RECORDS_AT_ONCE[0], default: Some(RECORDS_AT_ONCE[1]) },
    description: "Maximum number of records in the answer. It has fewer if their contents have more than 1 MiB.",
    example: "100",
};
const SHOW: Parameter = Parameter {
    name: "show",
    place: Place::Query,
    kind: Kind::Words(&runs::CHOICES),
    description: "Choice of the records: all of them (the default), the events of the cell, or what people did.",
    example: "events",
};
const STREAM_AFTER: Parameter = Parameter {
    name: "after",
    place: Place::Query,
    kind: Kind::Number { min: 0, max: MAX_EXACT, default: None },
    description: "Number of the record after which the stream begins, at most that of the last record; without it, the first record is sent first.",
    example: "0",
};
const LAST_EVENT_ID: Parameter = Parameter {
    name: "Last-Event-ID",
    place: Place::Header,
    kind: Kind::Number { min: 0, max: MAX_EXACT, default: None },
    description: "Number of the last record that the client has. It takes precedence over the parameter after. A browser sends it when it reconnects.",
    example: "0",
};
const FILE: Parameter = Parameter {
    name: "file",
    place: Place::Path,
    kind: Kind::Words(&maps::FILE_NAMES),
    description: "Name of the file.",
    example: "error_map.csv",
};

/// Returns the reference to the schema of `T`, and adds this schema to `schemas`.
fn schema_of<T: JsonSchema>(schemas: &mut SchemaGenerator) -> Value {
    schemas.subschema_for::<T>().to_value()
}

fn text(_: &mut SchemaGenerator) -> Value {
    json!({ "type": "string" })
}

/// Returns the schema of an event of a stream. OpenAPI 3.1 has no word for a stream, so it is that of each event.
fn stream_event(schemas: &mut SchemaGenerator) -> Value {
    let contents = [
        schema_of::<RecordedEvent>(schemas),
        schema_of::<RunState>(schemas),
        schema_of::<EndOfRecord>(schemas),
        schema_of::<ProblemDocument>(schemas),
    ];
    json!({
        "type": "object",
        "description": "Each event of the stream.",
        "required": ["event", "data"],
        "properties": {
            "event": { "type": "string", "enum": ["record", "state", "end", "problem"] },
            "id": { "type": "string", "pattern": "^[0-9]+$", "description": "Number of the record, or at the end that of the last record." },
            "data": {
                "type": "string",
                "contentMediaType": "application/json",
                "contentSchema": { "anyOf": contents },
                "description": "RecordedEvent of a record, RunState of a state, EndOfRecord of the end, Problem of a problem.",
            },
        },
    })
}

/// Returns the schema of a file, whose form is not JSON.
fn file_content(_: &mut SchemaGenerator) -> Value {
    json!({})
}

/// All endpoints.
static ENDPOINTS: [Endpoint; 11] = [
    Endpoint {
        path: "/api/v1/cell",
        id: "getCell",
        summary: "The cell now: its state, its active run and its last run.",
        description: "The state is that of the active run, by its PackML name, and Idle if no run is active.",
        parameters: &[],
        media: JSON,
        schema: schema_of::<CellNow>,
        empty: &[],
        problems: &[],
        handler: |call| Box::pin(runs::cell(call)),
    },
    Endpoint {
        path: "/api/v1/runs",
        id: "listRuns",
        summary: "The runs, from the newest to the oldest.",
        description: "Give next_cursor as the parameter cursor to read the next page.",
        parameters: &[LIMIT_OF_RUNS, CURSOR, PART, RESULT],
        media: JSON,
        schema: schema_of::<RunsPage>,
        empty: &[],
        problems: &[],
        handler: |call| Box::pin(runs::runs(call)),
    },
    Endpoint {
        path: "/api/v1/runs/{run}",
        id: "getRun",
        summary: "A run: its state, its limits, its machines and its alarms.",
        description: "While the run is under way, its state is that of its program.",
        parameters: &[RUN],
        media: JSON,
        schema: schema_of::<RunDetail>,
        empty: &[],
        problems: OF_RUN,
        handler: |call| Box::pin(runs::run(call)),
    },
    Endpoint {
        path: "/api/v1/runs/{run}/figures",
        id: "getFigures",
        summary: "The figures of each cycle of a run, with their intervals and limits.",
        description: "The figures are those of the last measurement of a cycle, as they are judged.",
        parameters: &[RUN],
        media: JSON,
        schema: schema_of::<RunFigures>,
        empty: &[],
        problems: OF_RUN,
        handler: |call| Box::pin(runs::figures(call)),
    },
    Endpoint {
        path: "/api/v1/runs/{run}/events",
        id: "listEvents",
        summary: "The record of a run, by the numbers of its records.",
        description: "Give next_after as the parameter after to read the next page. A run under way adds records.",
        parameters: &[RUN, AFTER, LIMIT_OF_RECORDS, SHOW],
        media: JSON,
        schema: schema_of::<EventsPage>,
        empty: &[],
        problems: OF_RUN,
        handler: |call| Box::pin(runs::events(call)),
    },
    Endpoint {
        path: "/api/v1/runs/{run}/stream",
        id: "streamEvents",
        summary: "The record and the state of a run as server-sent events.",
        description: "An event `record` has a record of the run as RecordedEvent, and its number as id. An event `state` has the state of the run as RunState, after the records before it. An event `end`, an EndOfRecord, comes after the last record of a run that has ended, and the stream ends. An event `problem` has a Problem, and the stream ends. A comment comes at least every 15 s.",
        parameters: &[RUN, STREAM_AFTER, LAST_EVENT_ID, SHOW],
        media: &["text/event-stream"],
        schema: stream_event,
        empty: &[(204, "The run has ended, and the client has all of its records.")],
        problems: &[
            ProblemKind::UnknownRun,
            ProblemKind::BeyondRecord,
            ProblemKind::UnreadableRecord,
            ProblemKind::TooManyStreams,
        ],
        handler: |call| Box::pin(stream::stream(call)),
    },
    Endpoint {
        path: "/api/v1/runs/{run}/maps",
        id: "listMaps",
        summary: "The error maps of a run, with the addresses of their files.",
        description: "Only files that exist now are in the answer.",
        parameters: &[RUN],
        media: JSON,
        schema: schema_of::<RunMaps>,
        empty: &[],
        problems: OF_RUN,
        handler: |call| Box::pin(maps::maps(call)),
    },
    Endpoint {
        path: "/api/v1/runs/{run}/cycles/{cycle}/map",
        id: "getMap",
        summary: "The error map of a cycle on its grid.",
        description: "The file error_map.csv has the same values with all their digits.",
        parameters: &[RUN, CYCLE],
        media: JSON,
        schema: schema_of::<MapGrid>,
        empty: &[NOT_MODIFIED],
        problems: &[
            ProblemKind::UnknownRun,
            ProblemKind::UnknownCycle,
            ProblemKind::NoFile,
            ProblemKind::TooLarge,
            ProblemKind::UnreadableRecord,
            ProblemKind::UnreadableFile,
        ],
        handler: |call| Box::pin(maps::map(call)),
    },
    Endpoint {
        path: "/api/v1/runs/{run}/cycles/{cycle}/files/{file}",
        id: "getFile",
        summary: "A file of a cycle.",
        description: "The error map as CSV, X3P, SVG or PNG, and the deviation of each point as CSV.",
        parameters: &[RUN, CYCLE, FILE],
        media: &maps::FILE_MEDIA,
        schema: file_content,
        empty: &[NOT_MODIFIED],
        problems: &[
            ProblemKind::UnknownRun,
            ProblemKind::UnknownCycle,
            ProblemKind::NoFile,
            ProblemKind::UnreadableRecord,
            ProblemKind::UnreadableFile,
        ],
        handler: |call| Box::pin(maps::file(call)),
    },
    Endpoint {
        path: "/api/openapi.json",
        id: "getDescription",
        summary: "This description.",
        description: "OpenAPI 3.1.",
        parameters: &[],
        media: JSON,
        schema: file_content,
        empty: &[NOT_MODIFIED],
        problems: &[],
        handler: |call| Box::pin(description(call)),
    },
    Endpoint {
        path: "/metrics",
        id: "getMetrics",
        summary: "Metrics for Prometheus.",
        description: "The text format of Prometheus, and OpenMetrics if the client prefers it.",
        parameters: &[],
        media: &metrics::MEDIA,
        schema: text,
        empty: &[],
        problems: &[],
        handler: |call| Box::pin(metrics::metrics(call)),
    },
];

/// Problems of an endpoint that reads the record of a run.
const OF_RUN: &[ProblemKind] = &[ProblemKind::UnknownRun, ProblemKind::UnreadableRecord];

/// Answers with the description of the interface.
async fn description(call: Call) -> Result<Response, Problem> {
    Ok(unless_known(&call.headers, "application/json", to_json(&document())?))
}

/// Returns the description of the interface in OpenAPI 3.1.
fn document() -> Value {
    openapi::document(&ENDPOINTS.iter().collect::<Vec<_>>(), env!("CARGO_PKG_VERSION"))
}

/// Returns the routes of the interface for programs, with their access control.
pub(crate) fn routes(page: Shared) -> Router {
    let guard = Arc::clone(&page.guard);
    let all = ENDPOINTS.iter().fold(Router::new(), |router, endpoint| router.route(endpoint.path, endpoint.route()));
    all.route("/api", any(unknown_address))
        .route("/api/{*rest}", any(unknown_address))
        .layer(from_fn_with_state(guard, let_in))
        .with_state(page)
}
