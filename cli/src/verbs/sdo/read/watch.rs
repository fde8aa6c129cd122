//! `ecaxis sdo read --watch`: prints the values that change.

use std::time::{Duration, SystemTime};

use ecaxis_master::mailbox::MailboxTransport;
use ecaxis_tools::document::format::utc;
use serde_json::json;

use super::{DataType, Open, Part, as_json, line};
use crate::hints::Failure;
use crate::render::{result, shown};
use crate::verbs::sdo::line_text;

/// Reads the objects each `period` and prints those that changed, until the program is
/// interrupted.
pub(super) async fn watch(
    open: &mut Open<'_>,
    parts: Vec<Part>,
    data_type: Option<DataType>,
    period: Duration,
    json: bool,
) -> Result<(), Failure> {
    let mut last = vec![None; parts.len()];
    loop {
        for ((at, name, known), last) in parts.iter().zip(&mut last) {
            let value = open.read(at.index, at.sub).await?;
            if last.as_ref() == Some(&value) {
                continue;
            }
            *last = Some(value.clone());
            let line = line((*at, name.clone(), data_type.or(*known), value));
            let time = now();
            if json {
                let mut object = as_json(&line);
                object["time"] = json!(time);
                result(&format!("{object}\n"))?;
            } else {
                shown(&format!("{time}  {}\n", line_text(&line)))?;
            }
        }
        open.at.wire.delay(period).await;
    }
}

/// Returns the date and time in UTC with milliseconds.
fn now() -> String {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    let since = since.unwrap_or_default();
    format!("{}.{:03}Z", utc(since.as_secs()), since.subsec_millis())
}
