//! Invalid gateway descriptions, and the objects of valid ones.

use super::*;

fn problem(options: &GatewayOptions) -> String {
    let result = options
        .check()
        .and_then(|()| options.configuration((64, 64)).map(drop));
    result.map_or_else(|error| error.to_string(), |()| "none".into())
}

fn with_link(link: PdoLink) -> GatewayOptions {
    let mut node = NodeOptions::new(1, Epos::E24_5);
    node.inputs.push(link);
    GatewayOptions {
        nodes: vec![node],
        ..GatewayOptions::default()
    }
}

fn link(pdo: u8, at: u16, contents: &[(u16, u8, u8)]) -> PdoLink {
    PdoLink {
        pdo,
        at,
        contents: contents.to_vec(),
        synchronous: true,
    }
}

#[test]
fn invalid_gateway_settings_are_rejected() {
    let node = |id, drive| GatewayOptions {
        nodes: vec![NodeOptions::new(id, drive)],
        ..GatewayOptions::default()
    };
    for (options, part) in [
        (
            GatewayOptions {
                node_id: 0,
                ..GatewayOptions::default()
            },
            "1 to 127",
        ),
        (
            GatewayOptions {
                bit_rate: 9600,
                ..GatewayOptions::default()
            },
            "kbit/s",
        ),
        (
            GatewayOptions {
                input_size: Some(1),
                ..GatewayOptions::default()
            },
            "2 to 512",
        ),
        (
            GatewayOptions {
                output_size: Some(513),
                ..GatewayOptions::default()
            },
            "2 to 512",
        ),
        (node(16, Epos::E24_1), "up to 15"),
        (node(128, Epos::E70_10), "up to 127"),
        (node(99, Epos::E70_10), "twice"),
        (with_link(link(4, 2, &[])), "PDOs 1 to 3"),
        (with_link(link(0, 2, &[])), "PDOs 1 to 3"),
        (with_link(link(3, 2, &[(0x6041, 0, 16)])), "static"),
        (with_link(link(1, 1, &[])), "first word"),
        (with_link(link(1, 63, &[])), "byte 64"),
        (with_link(link(1, 2, &[(0x6040, 0, 16)])), "0x6040:00"),
        (
            with_link(link(
                1,
                2,
                &[(0x6064, 0, 32), (0x606c, 0, 32), (0x6041, 0, 16)],
            )),
            "10 bytes",
        ),
        (with_link(link(2, 58, &[])), "none"),
    ] {
        assert!(
            problem(&options).contains(part),
            "{part}: {}",
            problem(&options)
        );
    }
}

#[test]
fn pdo_link_configures_gateway_and_node() {
    let options = with_link(link(2, 130, &[(0x6064, 0, 32)]));
    let configuration = options.configuration((512, 16)).unwrap();
    for setting in [
        u32_(0x1400, 1, 0x281),
        u8_(0x1400, 2, 255),
        // Byte 130 of the process data is the first of 0x2101.
        u32_(0x1600, 1, 0x2101_0108),
        u32_(0x1600, 4, 0x2101_0408),
        u8_(0x1600, 0, 4),
        u32_(0x1016, 1, 0x1_0078),
        u32_(0x1f81, 1, 0x5),
    ] {
        assert!(configuration.gateway.contains(&setting), "{setting:x?}");
    }
    let node = [
        u16_(0x1017, 0, 100),
        u8_(0x1801, 2, 1),
        u8_(0x1a01, 0, 0),
        u32_(0x1a01, 1, 0x6064_0020),
        u8_(0x1a01, 0, 1),
    ];
    assert_eq!(configuration.nodes, [(1, node.to_vec())]);
}
