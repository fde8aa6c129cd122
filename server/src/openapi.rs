//! The interface over HTTP as an OpenAPI 3.1 document, from the types that read the requests.

use serde_json::{Map, Value, json};

use crate::command::operations;

/// The other paths: method, path, description, names of the query, type of the answer.
const PATHS: &[(&str, &str, &[&str], &str)] = &[
    (
        "/api/machine",
        "Returns the machine: axes, devices, signals, steps.",
        &[],
        JSON,
    ),
    (
        "/api/state",
        "Returns the state of the bus, the axes and the devices.",
        &[],
        JSON,
    ),
    (
        "/api/events",
        "Returns the events with a number above `after`.",
        &["after"],
        JSON,
    ),
    (
        "/api/histogram",
        "Returns the distribution of the times of a cycle.",
        &[],
        JSON,
    ),
    ("/api/recordings", "Lists the recordings.", &[], JSON),
    (
        "/api/samples",
        "Returns rows of samples as a binary frame, see docs/server.md.",
        &["signals", "first", "count"],
        BYTES,
    ),
    (
        "/api/history",
        "Returns the least and the greatest values as a binary frame, see docs/server.md.",
        &["signals", "from_ns", "to_ns", "buckets"],
        BYTES,
    ),
    (
        "/api/export.csv",
        "Returns the samples as CSV.",
        &["signals", "from_ns", "to_ns"],
        "text/csv",
    ),
    (
        "/api/export.mcap",
        "Returns the samples as MCAP.",
        &["signals", "from_ns", "to_ns"],
        BYTES,
    ),
    (
        "/metrics",
        "Returns the metrics as Prometheus text.",
        &[],
        "text/plain",
    ),
];
const JSON: &str = "application/json";
const BYTES: &str = "application/octet-stream";

/// Returns the document.
#[must_use]
pub fn document() -> Value {
    let mut paths = Map::new();
    for (path, about, query, kind) in PATHS {
        let parameters: Vec<_> = query
            .iter()
            .map(|name| {
                let kind = match *name {
                    "signals" => {
                        json!({"type": "string", "description": "names with commas between"})
                    }
                    _ => json!({"type": "integer", "minimum": 0}),
                };
                json!({"name": name, "in": "query", "schema": kind})
            })
            .collect();
        let content = json!({(*kind): {"schema": {}}});
        let get = json!({
            "operationId": path.trim_start_matches('/').replace(['/', '.'], "_"),
            "summary": about,
            "parameters": parameters,
            "responses": {"200": {"description": "done", "content": content}},
        });
        paths.insert((*path).to_owned(), json!({"get": get}));
    }
    for (name, about, schema) in operations() {
        if matches!(
            name.as_str(),
            "token" | "subscribe" | "unsubscribe" | "area"
        ) {
            continue;
        }
        let post = json!({
            "operationId": name,
            "summary": about,
            "security": [{"token": []}],
            "requestBody": {"content": {(JSON): {"schema": schema}}},
            "responses": {
                "200": {"description": "done", "content": {(JSON): {"schema": {"type": "object"}}}},
                "4XX": {"description": "refused", "content": {
                    (JSON): {"schema": {"$ref": "#/components/schemas/Refusal"}}}},
            },
        });
        let path = paths
            .entry(format!("/api/{name}"))
            .or_insert_with(|| json!({}));
        path["post"] = post;
    }
    json!({
        "openapi": "3.1.0",
        "info": {"title": "ecaxis serve", "version": env!("CARGO_PKG_VERSION")},
        "paths": paths,
        "components": {
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
            "schemas": {"Refusal": {
                "type": "object",
                "required": ["ok", "error"],
                "properties": {
                    "ok": {"const": false},
                    "error": {
                        "type": "object",
                        "required": ["code", "message"],
                        "properties": {
                            "code": {"type": "string"},
                            "message": {"type": "string"},
                            "help": {"type": "string"},
                        },
                    },
                },
            }},
        },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_operation_has_a_path() {
        let document = document();
        let paths = document["paths"].as_object().unwrap();
        // `machine`, `state` and `events` have both methods.
        assert_eq!(paths.len(), PATHS.len() + operations().len() - 4 - 3);
        let body = &paths["/api/move"]["post"]["requestBody"]["content"][JSON]["schema"];
        assert_eq!(body["required"], json!(["axis"]));
        assert!(body["properties"]["op"].is_null());
        assert_eq!(body["properties"]["to"]["type"], json!(["number", "null"]));
    }
}
