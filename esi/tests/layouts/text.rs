//! Formats numbers as lines and shows the difference between two texts.

use std::fmt::Write;

use ecaxis_esi::{Device, Field, Pdo, SelectError, Selection, SmLayout, StartupSdo};

/// Longer data is shown as length and digest.
const SHOWN_BYTES: usize = 20;

pub fn device(device: &Device) -> String {
    let id = device.identity;
    let mut out = format!(
        "device {:08x} {:08x}, line {}, profile {}\n",
        id.product,
        id.revision,
        device.position.line,
        device.profile.map_or("none".to_owned(), |n| n.to_string())
    );
    let mut flags = Vec::new();
    if let Some(mailbox) = &device.mailbox {
        if let Some(coe) = &mailbox.coe {
            flags.push("coe");
            for (set, name) in [
                (coe.sdo_info, "info"),
                (coe.pdo_assign, "assign"),
                (coe.pdo_config, "config"),
                (coe.pdo_upload, "upload"),
                (coe.complete_access, "complete"),
            ] {
                if set {
                    flags.push(name);
                }
            }
        }
        for (set, name) in [
            (mailbox.foe, "foe"),
            (mailbox.eoe.is_some(), "eoe"),
            (mailbox.soe.is_some(), "soe"),
            (mailbox.aoe, "aoe"),
            (mailbox.voe, "voe"),
        ] {
            if set {
                flags.push(name);
            }
        }
    }
    let sms: Vec<String> = device
        .sync_managers
        .iter()
        .map(|sm| {
            format!(
                "{:?} {:04x}+{}",
                sm.usage, sm.start_address, sm.default_size
            )
        })
        .collect();
    let _ = writeln!(out, "  mailbox {}; sm {}", flags.join(" "), sms.join(", "));
    out
}

pub fn error(error: &SelectError) -> String {
    let text = format!("{error:?}");
    let kind: String = text
        .chars()
        .take_while(char::is_ascii_alphanumeric)
        .collect();
    format!("refused, {kind}")
}

pub fn dc(selection: &Selection) -> String {
    selection.dc.as_ref().map_or_else(String::new, |dc| {
        format!(
            " dc {:04x} sync0 {}{:+} sync1 {:+}",
            dc.assign_activate, dc.sync0_cycle_ns, dc.sync0_shift_ns, dc.sync1_delay_ns
        )
    })
}

/// Formats a selection without its clocks.
pub fn selection(selection: &Selection) -> Vec<String> {
    let mut lines = Vec::new();
    for module in &selection.modules {
        lines.push(format!(
            "place {} module {:08x}",
            module.place, module.ident
        ));
    }
    let layout = &selection.layout;
    for (name, sms, pdos, fields) in [
        ("rx", &layout.outputs, &selection.rx, &layout.rx),
        ("tx", &layout.inputs, &selection.tx, &layout.tx),
    ] {
        direction(&mut lines, name, sms, pdos, fields);
    }
    let mut transition = "";
    for sdo in &selection.startup {
        if sdo.transition != transition {
            transition = sdo.transition;
            lines.push(format!("start {transition}"));
        }
        lines.push(format!("  {}", command(sdo)));
    }
    for note in &selection.notes {
        // A note may quote names from the file, so only its word count is kept.
        lines.push(format!("note of {} words", note.split_whitespace().count()));
    }
    lines
}

fn direction(
    lines: &mut Vec<String>,
    name: &str,
    sms: &[SmLayout],
    pdos: &[Pdo],
    fields: &[Field],
) {
    for sm in sms {
        let fmmu = sm.fmmu.map_or("-".to_owned(), |n| n.to_string());
        lines.push(format!(
            "{name} sm{} {:04x}+{} control {:02x} fmmu {fmmu}",
            sm.sm, sm.start_address, sm.len, sm.control_byte
        ));
    }
    for pdo in pdos {
        let mut line = format!(
            "  {:04x} sm{}",
            pdo.index,
            pdo.sm.map_or("-".to_owned(), |n| n.to_string())
        );
        for field in fields.iter().filter(|field| field.pdo == pdo.index) {
            let _ = write!(
                line,
                " {:04x}:{:02x}@{}+{}",
                field.index, field.sub, field.bit_offset, field.bit_len
            );
        }
        lines.push(line);
    }
}

fn command(sdo: &StartupSdo) -> String {
    let whole = if sdo.complete_access { " whole" } else { "" };
    let data: String = if sdo.data.len() > SHOWN_BYTES {
        let hex: String = sdo.data.iter().map(|byte| format!("{byte:02x}")).collect();
        format!("{} bytes {}", sdo.data.len(), digest(&[hex]))
    } else {
        sdo.data.iter().map(|byte| format!("{byte:02x}")).collect()
    };
    format!("{:04x}:{:02x}{whole} = {data}", sdo.index, sdo.sub)
}

/// Returns SyncManager lengths and PDOs in one line.
pub fn short(selection: &Selection) -> String {
    let layout = &selection.layout;
    let mut parts = Vec::new();
    for (name, sms, pdos) in [
        ("rx", &layout.outputs, &selection.rx),
        ("tx", &layout.inputs, &selection.tx),
    ] {
        if sms.is_empty() && pdos.is_empty() {
            continue;
        }
        let sms: Vec<String> = sms
            .iter()
            .map(|sm| format!("sm{} {:04x}+{}", sm.sm, sm.start_address, sm.len))
            .collect();
        let pdos: Vec<String> = pdos
            .iter()
            .map(|pdo| format!("{:04x}", pdo.index))
            .collect();
        parts.push(format!("{name} {} [{}]", sms.join(" "), pdos.join(" ")));
    }
    parts.push(format!("start {}", selection.startup.len()));
    parts.join(", ")
}

/// Returns the 64-bit FNV-1a hash of the lines.
pub fn digest(lines: &[String]) -> String {
    let bytes = lines.iter().flat_map(|line| line.bytes().chain([b'\n']));
    let hash = bytes.fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    });
    format!("#{hash:016x}")
}

/// Returns the differing lines, each after its device.
pub fn difference(before: &str, now: &str) -> String {
    const SHOWN: usize = 40;
    let (before, now): (Vec<&str>, Vec<&str>) = (before.lines().collect(), now.lines().collect());
    let same = before.iter().zip(&now).take_while(|(a, b)| a == b).count();
    let (old, new) = (&before[same..], &now[same..]);
    let same_end = old
        .iter()
        .rev()
        .zip(new.iter().rev())
        .take_while(|(a, b)| a == b)
        .count();
    let mut out = String::new();
    let head = now[..same]
        .iter()
        .rev()
        .find(|line| line.starts_with("device"));
    let _ = writeln!(
        out,
        "  line {}, {}",
        same + 1,
        head.unwrap_or(&"at the start")
    );
    for (sign, lines) in [("-", old), ("+", new)] {
        let lines = &lines[..lines.len() - same_end];
        for line in lines.iter().take(SHOWN) {
            let _ = writeln!(out, "  {sign}{line}");
        }
        if lines.len() > SHOWN {
            let _ = writeln!(out, "  {sign}… and {} lines more", lines.len() - SHOWN);
        }
    }
    out
}

#[test]
fn difference_shows_the_change_and_its_device() {
    let text = difference("device 1\n  a\n  b\n  c\n", "device 1\n  a\n  x\n  c\n");
    assert_eq!(text, "  line 3, device 1\n  -  b\n  +  x\n");
}
