//! Orders from the fleet to a machine.

use serde_json::{Value, json};

/// Returns the answer to an order. An agent without keys is read-only.
#[must_use]
pub fn answer(_order: &[u8]) -> Value {
    json!({"ok": false, "error": {"code": "refused", "message": "refused: no keys"}})
}
