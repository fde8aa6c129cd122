//! The emergency messages of devices as a table.

use ecaxis_master::session::EmergencyLine;

use crate::render::report::Table;

/// Formats the stored emergencies and the number of further ones. Ends with a line feed.
pub(crate) fn table(emergencies: &[EmergencyLine], more: u64) -> String {
    let mut table = Table::new(&["time", "device", "emergency", "register", "data", "what"]);
    for line in emergencies {
        let [a, b, c, d, e] = line.data;
        table.row([
            &format!("{:.3} s", line.at_s),
            &line.device,
            &format!("0x{:04x}", line.code),
            &format!("0x{:02x}", line.register),
            &format!("{a:02x} {b:02x} {c:02x} {d:02x} {e:02x}"),
            &line.text,
        ]);
    }
    let mut text = table.shown(2);
    text.push('\n');
    match more {
        0 => {}
        1 => text += "  1 more emergency is not kept\n",
        n => text += &format!("  {n} more emergencies are not kept\n"),
    }
    text
}
