//! Start-up lists compared with those of another tool for the same file.

use super::*;

/// Another tool's configuration of the same file with its default module must contain the same
/// commands in the same order. Whole assignments use complete access. PdoConfig is not set, so no
/// contents are written. 9 comes before Op.
#[test]
fn startup_commands_match_a_recorded_eni() {
    let Some(file) = file("esi/hpmicro/ECAT_CIA402.xml") else {
        return;
    };
    let Some(eni) = common::read("eni/CherryECAT_CIA402_ENI.xml") else {
        return;
    };
    let choice = SelectOptions {
        cycle_ns: MS,
        ..SelectOptions::default()
    };
    let selection = choose(&file, &choice).unwrap();
    let ours: Vec<_> = selection
        .startup
        .iter()
        .map(|sdo| InitCmd {
            transitions: vec![sdo.transition.to_owned()],
            index: sdo.index,
            sub: sdo.sub,
            complete_access: sdo.complete_access,
            data: sdo.data.clone(),
        })
        .collect();
    let recorded = coe_init_cmds(std::str::from_utf8(&eni).unwrap());
    assert_eq!(recorded.len(), 3);
    assert_eq!(ours, recorded);
    assert_eq!(
        (selection.layout.rx_bytes(), selection.layout.tx_bytes()),
        (8, 8)
    );
}

#[derive(Debug, Default, PartialEq, Eq)]
struct InitCmd {
    transitions: Vec<String>,
    index: u16,
    sub: u8,
    complete_access: bool,
    data: Vec<u8>,
}

/// Returns the CoE commands of an ENI, read without the ecaxis reader.
fn coe_init_cmds(eni: &str) -> Vec<InitCmd> {
    let coe = eni.split("<CoE>").nth(1).unwrap();
    let coe = coe.split("</CoE>").next().unwrap();
    let text = |part: &str, tag: &str| {
        let rest = part.split(&format!("<{tag}>")).nth(1)?;
        Some(rest.split("</").next()?.trim().to_owned())
    };
    coe.split("<InitCmd")
        .filter(|part| part.contains("</InitCmd>"))
        .map(|part| {
            let hex = text(part, "Data").unwrap();
            let byte = |at: usize| u8::from_str_radix(&hex[at..at + 2], 16).unwrap();
            InitCmd {
                transitions: vec![text(part, "Transition").unwrap()],
                index: text(part, "Index").unwrap().parse().unwrap(),
                sub: text(part, "SubIndex").unwrap().parse().unwrap(),
                complete_access: part
                    .split('>')
                    .next()
                    .unwrap()
                    .contains("CompleteAccess=\"true\""),
                data: (0..hex.len()).step_by(2).map(byte).collect(),
            }
        })
        .collect()
}
