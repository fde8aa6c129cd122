//! A Zenoh router. `zenohd` with the same configuration does the same.

use std::path::Path;

use crate::config::{self, Role, ZenohFile};
use crate::error::{Error, Result};
use crate::session;

/// Routes until SIGINT or SIGTERM.
///
/// # Errors
/// Fails if the file is wrong or an endpoint is not free.
pub async fn run(path: &Path) -> Result<()> {
    let file: ZenohFile = config::read(path)?;
    let config = config::zenoh(&file.zenoh, path, Role::Router)?;
    let session = session::open(config).await?;
    tracing::info!(id = %session.zid(), "router");
    session::terminated().await?;
    let failed = |error: zenoh::Error| Error::new(format!("closing the session: {error}"));
    session.close().await.map_err(failed)
}
