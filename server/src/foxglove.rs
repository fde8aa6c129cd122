//! The root of the HTTP server.

use axum::response::Response;

/// Returns the page.
pub async fn root() -> Response {
    crate::page::index()
}
