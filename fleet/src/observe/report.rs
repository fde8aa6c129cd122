//! `report`: fault reports of machines, also of those that are gone if an archive has them.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use zenoh::Session;

use super::{TIMEOUT, print};
use crate::error::{Error, Result};
use crate::keys::{ALL_REPORTS, MachineId};
use crate::options::{Network, ReportAction};
use crate::reports::{ReportId, Summary};
use crate::session;

/// The time for the replies. The lists of a long history are long, and a network may be slow.
const LIST_TIMEOUT: Duration = Duration::from_secs(30);
/// The time until a report is asked for again.
const REPEAT: Duration = Duration::from_millis(500);

/// Lists or shows fault reports.
///
/// # Errors
/// Fails if no router is reached, or the report is not there.
pub async fn run(network: &Network, action: ReportAction) -> Result<()> {
    let session = session::open_observer(network).await?;
    match action {
        ReportAction::List { machine, json } => {
            let key = machine.map_or(ALL_REPORTS.to_owned(), |id| id.key("reports"));
            let reports = list(&session, &key).await?;
            if json {
                print(&serde_json::json!(reports).to_string())?;
            } else {
                for report in reports {
                    let time = report.unix_time.map_or("-".to_owned(), |t| t.to_string());
                    let headline = report.headline.escape_debug();
                    let id = &report.id.as_str()[..12];
                    print(&format!("{id}  {time:>10}  {}  {headline}", report.machine))?;
                }
            }
        }
        ReportAction::Show { id } => show(&session, &id).await?,
    }
    let failed = |error: zenoh::Error| Error::new(format!("closing the session: {error}"));
    session.close().await.map_err(failed)
}

/// Returns the reports of all that answer, each once, newest first.
async fn list(session: &Session, selector: &str) -> Result<Vec<Summary>> {
    let mut reports = BTreeMap::new();
    let replies = session::query(session, selector, LIST_TIMEOUT).await?;
    replies.warn_if_incomplete("reports", LIST_TIMEOUT);
    for reply in replies.all {
        let machine = MachineId::of_key(&reply.key).map(|(id, _)| id);
        for summary in reply.json::<Vec<Summary>>().unwrap_or_default() {
            if Some(&summary.machine) == machine.as_ref() {
                reports.insert(summary.id.clone(), summary);
            }
        }
    }
    let mut reports: Vec<_> = reports.into_values().collect();
    reports.sort_by_key(|report| Reverse((report.unix_time, report.event)));
    Ok(reports)
}

async fn show(session: &Session, prefix: &str) -> Result<()> {
    let reports = list(session, ALL_REPORTS).await?;
    let mut found = reports
        .iter()
        .filter(|report| report.id.as_str().starts_with(prefix));
    let help = "`ecaxis-fleet report list` has the ids";
    let Some(report) = found.next() else {
        return Err(Error::new(format!("report {prefix}: none begins like this")).help(help));
    };
    if found.next().is_some() {
        return Err(Error::new(format!("report {prefix}: several begin like this")).help(help));
    }
    let key = report
        .machine
        .key(&format!("report/{}", report.id.as_str()));
    let began = Instant::now();
    loop {
        let replies = session::query(session, &key, LIST_TIMEOUT).await?;
        let mut replies = replies.all.iter();
        if let Some(reply) = replies.find(|reply| ReportId::of(&reply.bytes) == report.id) {
            return print(&String::from_utf8_lossy(&reply.bytes));
        }
        // A connection that is lost meanwhile comes again after 1 to 4 s.
        if began.elapsed() > 2 * TIMEOUT {
            let what = format!("report {prefix}: {} does not answer", report.machine);
            return Err(Error::new(what).help("run an archive to keep the reports of machines"));
        }
        tokio::time::sleep(REPEAT).await;
    }
}
