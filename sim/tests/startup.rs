//! Start-up downloads of ESI and machine file against the dictionary.

use crate::common::*;
use ecaxis_esi::model::{InitCmd, ObjectCode, Position, SlotDependence, Writable};
use ecaxis_sim::{DeviceOptions, SimDevice, StartupWrite};

const S: u16 = 0x1001;

fn init_cmd(index: u16, sub: u8, complete_access: bool, data: &[u8]) -> InitCmd {
    InitCmd {
        index,
        sub,
        complete_access,
        data: data.to_vec(),
        transitions: vec!["PS".into()],
        position: Position::default(),
        depends_on: SlotDependence::default(),
        fixed: false,
        overwritten_by_module: false,
        adapts: false,
        comment: String::new(),
    }
}

/// The vendor's device takes its own InitCmds, so the dictionary of its ESI is wrong where it
/// contradicts them. All other downloads are checked.
#[test]
fn own_init_cmds_pass_a_dictionary_that_contradicts_them() {
    const READ_ONLY: Refusal = Refusal::Abort(0x0601_0002);
    let mut device = coe_device();
    let mut count = object(0x2010, vec![item(0, 16, 0, Writable::Always, &[0])]);
    count.code = ObjectCode::Array;
    device.dictionary.objects.push(count);
    let coe = device.mailbox.as_mut().unwrap().coe.as_mut().unwrap();
    coe.complete_access = false;
    coe.init_cmds = vec![
        // Read-only; shorter and longer than the object; out of range; not in the dictionary.
        init_cmd(0x2003, 0, false, &[8, 0, 0, 0]),
        init_cmd(0x2001, 0, false, &[9]),
        init_cmd(0x2000, 0, false, &[11, 0, 0, 0, 0]),
        init_cmd(0x3000, 2, false, &[12, 13]),
        init_cmd(0x3001, 0, true, &[3, 0, 0xaa, 0xbb, 0xcc]),
    ];
    let options = DeviceOptions {
        startup: vec![StartupWrite {
            index: 0x3002,
            sub: 0,
            complete_access: false,
            data: vec![1, 2, 3, 4],
        }],
        ..DeviceOptions::default()
    };
    let sim = SimDevice::from_esi(&device, &[], options).unwrap();
    let mut bus = Bus::new(vec![sim]);
    bus.address_all();
    bus.preop(S);

    assert_eq!(bus.download(S, 0x2003, 0, &[9, 0, 0, 0]), Err(READ_ONLY));
    assert_eq!(
        bus.download(S, 0x2000, 0, &[11, 0, 0, 0]),
        Err(Refusal::Abort(0x0609_0031))
    );
    assert_eq!(
        bus.download(S, 0x2001, 0, &[8]),
        Err(Refusal::Abort(0x0607_0013))
    );
    for (index, sub, data, value) in [
        (0x2003, 0, &[8, 0, 0, 0][..], &[8, 0, 0, 0][..]),
        (0x2001, 0, &[9], &[9, 0]),
        (0x2000, 0, &[11, 0, 0, 0, 0], &[11, 0, 0, 0]),
        (0x3000, 2, &[12, 13], &[12, 13]),
        (0x3002, 0, &[1, 2, 3, 4], &[1, 2, 3, 4]),
        // ETG.1000.6: the number of elements has 8 bits, whatever the file says.
        (0x2010, 0, &[1], &[1]),
    ] {
        assert_eq!(bus.download(S, index, sub, data), Ok(()), "0x{index:04x}");
        assert_eq!(
            bus.upload(S, index, sub).as_deref(),
            Ok(value),
            "0x{index:04x}"
        );
    }
    let whole = [3, 0, 0xaa, 0xbb, 0xcc];
    assert_eq!(bus.download_with(S, 0x10, 0x3001, 0, &whole), Ok(()));
    assert_eq!(bus.upload(S, 0x3001, 1).as_deref(), Ok(&whole[2..]));
}
