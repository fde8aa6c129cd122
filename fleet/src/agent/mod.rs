//! The agent of a machine: from the socket of `ecaxis serve` to Zenoh. It reads; only orders and
//! line shafts change something.

pub mod events;
pub mod line_shaft;
pub mod publish;
pub mod reader;
pub mod setpoints;
pub mod state;

use std::path::Path;
use std::sync::Arc;
use std::thread;

use tokio::sync::mpsc;

use crate::config::{self, AgentFile, Role};
use crate::error::{Error, Result};
use crate::orders::executor::OrderExecutor;
use crate::orders::sender::ZenohSource;
use crate::reports::ReportStore;
use crate::session;
use events::Events;
use line_shaft::LineShaft;
use publish::Publisher;
use reader::Reader;
use setpoints::SetPoints;

/// The fault reports that an agent keeps. The server itself has 20.
const MAX_REPORTS: usize = 500;
/// The updates that wait for Zenoh. More of them are dropped: a newer state follows, and the
/// archive queries what it has missed.
pub const UPDATES: usize = 256;

/// Publishes a machine until SIGINT or SIGTERM.
///
/// # Errors
/// Fails if the file is wrong or the spool cannot be read. It waits for an absent server or router.
pub async fn run(path: &Path) -> Result<()> {
    let file: AgentFile = config::read(path)?;
    let zenoh = config::zenoh(&file.zenoh, path, Role::Service)?;
    let interval = file.setpoints_interval()?;
    file.check_line_shafts()?;
    let id = file.id();
    let spool = config::resolve(path, &file.spool);
    let store = ReportStore::open(&spool.join("reports"), MAX_REPORTS).map_err(|error| {
        Error::new(format!("spool {}: {error}", spool.display()))
            .help("give the folder to the user of the agent")
    })?;
    let store = Arc::new(store);
    let socket = config::resolve(path, &file.socket);
    let events = Arc::new(Events::default());
    let (updates, received) = mpsc::channel(UPDATES);
    let reader = Reader {
        id: id.clone(),
        socket: socket.clone(),
        page: file.page.clone(),
        store: Arc::clone(&store),
        events: Arc::clone(&events),
        updates,
    };
    // Its connection to the server blocks. Without Zenoh, it still spools reports.
    spawn("reader", move || reader.run())?;
    tracing::info!(machine = %id, socket = %socket.display(), "agent");
    // A switch that was interrupted is finished without Zenoh.
    let source = Arc::new(ZenohSource::new(id.clone()));
    let orders = file.orders.as_ref().map(|table| {
        let (id, socket, source) = (id.clone(), socket.clone(), Arc::clone(&source));
        let orders = OrderExecutor::open(path, id, socket, table, &file.key, source)?;
        orders.resume()?;
        Ok(orders)
    });
    let orders = orders.transpose()?;
    tokio::select! {
        ended = async {
            let session = session::open(zenoh).await?;
            tracing::info!(machine = %id, "connected");
            source.connect(session.clone());
            for axis in file.setpoints {
                let (session, id, socket) = (session.clone(), id.clone(), socket.clone());
                let setpoints = SetPoints { session, id, socket, axis, interval };
                spawn("set-points", move || setpoints.run())?;
            }
            for table in file.line_shaft {
                let (session, socket) = (session.clone(), socket.clone());
                let shaft = LineShaft { session, socket, table };
                spawn("line shaft", move || shaft.run())?;
            }
            let publisher = Publisher::new(session, id.clone(), store, events, Some(socket));
            publisher.with_orders(orders).run(received).await
        } => ended,
        ended = session::terminated() => ended,
    }
}

/// Starts a thread, because the connection to the server blocks.
fn spawn(name: &str, run: impl FnOnce() + Send + 'static) -> Result<()> {
    let spawned = thread::Builder::new().name(name.to_owned()).spawn(run);
    spawned.map_err(|error| Error::new(format!("starting a thread: {error}")))?;
    Ok(())
}
