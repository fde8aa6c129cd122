//! Metrics in the Prometheus text format.

use crate::hub::Hub;

/// Returns all metrics.
#[must_use]
pub fn text(hub: &Hub) -> String {
    let _ = hub;
    String::new()
}
