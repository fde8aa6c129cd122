//! Differences between two images, field by field, usually between a device's EEPROM and its ESI.

use std::fmt::Display;

use crate::address;
use crate::model::FmmuUse;

use super::{General, MailboxAreas, Protocols, Sii, SiiDc, SiiPdo};

/// The aspect of the device that a difference affects.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum DifferenceKind {
    /// Another device, or another revision of it.
    Identity,
    /// Settings that a MainDevice uses: mailbox, SyncManagers, FMMUs, PDOs, clocks.
    Behaviour,
    /// Names and other display texts.
    Description,
    /// Values that are individual to each unit: serial number, alias.
    Instance,
}

/// One differing field.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Difference {
    /// The kind of contents.
    pub aspect: DifferenceKind,
    /// The field, such as `RxPdo 0x1600 / entry 2 / bits`.
    pub field: String,
    /// The value in the expected image.
    pub expected: String,
    /// The value in the other image.
    pub found: String,
}

/// Returns every field in which `found` differs from `expected`, in image order.
#[must_use]
pub fn compare(expected: &Sii, found: &Sii) -> Vec<Difference> {
    let mut list = List(Vec::new());
    header(&mut list, expected, found);
    general(&mut list, expected.general.as_ref(), found.general.as_ref());
    // Images pad an odd number of FMMUs, some with an unused FMMU.
    let usages = |sii: &Sii| {
        let used = sii.fmmus.iter().rposition(|usage| *usage != FmmuUse::Other);
        sii.fmmus
            .iter()
            .take(used.map_or(0, |last| last + 1))
            .copied()
            .collect::<Vec<_>>()
    };
    list.items(
        DifferenceKind::Behaviour,
        "FMMU",
        &usages(expected),
        &usages(found),
        |fmmu| format!("{fmmu:?}"),
    );
    list.items(
        DifferenceKind::Behaviour,
        "FMMU detail",
        &expected.fmmu_details,
        &found.fmmu_details,
        |detail| format!("{detail:?}"),
    );
    list.items(
        DifferenceKind::Behaviour,
        "sync unit",
        &expected.sync_units,
        &found.sync_units,
        |flags| format!("{flags:#04x}"),
    );
    list.items(
        DifferenceKind::Behaviour,
        "SyncManager",
        &expected.sync_managers,
        &found.sync_managers,
        |sm| {
            format!(
                "{:?} at 0x{:04x}, {} bytes, control 0x{:02x}, enable 0x{:02x}",
                sm.usage, sm.start_address, sm.len, sm.control, sm.enable
            )
        },
    );
    pdos(&mut list, "RxPdo", &expected.rx_pdos, &found.rx_pdos);
    pdos(&mut list, "TxPdo", &expected.tx_pdos, &found.tx_pdos);
    dc(&mut list, &expected.dc, &found.dc);
    list.items(
        DifferenceKind::Description,
        "further category",
        &expected.others,
        &found.others,
        |(kind, data)| format!("{kind} with {} bytes", data.len()),
    );
    list.0
}

struct List(Vec<Difference>);

impl List {
    fn add(
        &mut self,
        aspect: DifferenceKind,
        field: impl Display,
        expected: String,
        found: String,
    ) {
        self.0.push(Difference {
            aspect,
            field: field.to_string(),
            expected,
            found,
        });
    }

    fn field<T: PartialEq>(
        &mut self,
        aspect: DifferenceKind,
        field: impl Display,
        [expected, found]: [&T; 2],
        show: impl Fn(&T) -> String,
    ) {
        if expected != found {
            self.add(aspect, field, show(expected), show(found));
        }
    }

    fn text(&mut self, field: impl Display, [expected, found]: [&String; 2]) {
        self.field(
            DifferenceKind::Description,
            field,
            [expected, found],
            |text| format!("{text:?}"),
        );
    }

    /// Compares two ordered lists. Items are numbered from 0.
    fn items<T: PartialEq>(
        &mut self,
        aspect: DifferenceKind,
        what: &str,
        expected: &[T],
        found: &[T],
        show: impl Fn(&T) -> String,
    ) {
        let show = |item: Option<&T>| item.map_or_else(|| "none".to_owned(), &show);
        for n in 0..expected.len().max(found.len()) {
            let (a, b) = (expected.get(n), found.get(n));
            if a != b {
                self.add(aspect, format_args!("{what} {n}"), show(a), show(b));
            }
        }
    }
}

fn header(list: &mut List, a: &Sii, b: &Sii) {
    let hex = |value: &u32| format!("0x{value:08x}");
    let (id, other) = (a.identity, b.identity);
    list.field(
        DifferenceKind::Identity,
        "vendor",
        [&id.vendor, &other.vendor],
        hex,
    );
    list.field(
        DifferenceKind::Identity,
        "product code",
        [&id.product, &other.product],
        hex,
    );
    list.field(
        DifferenceKind::Identity,
        "revision",
        [&id.revision, &other.revision],
        hex,
    );
    list.field(
        DifferenceKind::Instance,
        "serial number",
        [&a.serial, &b.serial],
        hex,
    );
    list.field(
        DifferenceKind::Instance,
        "alias",
        [&a.alias, &b.alias],
        u16::to_string,
    );
    list.field(
        DifferenceKind::Behaviour,
        "checksum",
        [&a.checksum_ok, &b.checksum_ok],
        |ok| if *ok { "right" } else { "wrong" }.to_owned(),
    );
    // Excludes the alias, which is word 4 of the configuration.
    let config = |sii: &Sii| {
        let words = sii
            .config
            .chunks_exact(2)
            .enumerate()
            .filter(|(n, _)| *n != 4);
        words
            .map(|(_, word)| u16::from_le_bytes([word[0], word[1]]))
            .collect::<Vec<u16>>()
    };
    list.field(
        DifferenceKind::Behaviour,
        "PDI configuration",
        [&config(a), &config(b)],
        |words| {
            let words: Vec<String> = words.iter().map(|word| format!("{word:04x}")).collect();
            words.join(" ")
        },
    );
    let areas = |areas: &MailboxAreas| {
        format!(
            "to the device {} bytes at 0x{:04x}, from it {} bytes at 0x{:04x}",
            areas.receive_size, areas.receive_offset, areas.send_size, areas.send_offset
        )
    };
    list.field(
        DifferenceKind::Behaviour,
        "mailbox",
        [&a.mailbox, &b.mailbox],
        areas,
    );
    list.field(
        DifferenceKind::Behaviour,
        "bootstrap mailbox",
        [&a.bootstrap, &b.bootstrap],
        areas,
    );
    list.field(
        DifferenceKind::Behaviour,
        "mailbox protocols",
        [&a.protocols, &b.protocols],
        |protocols| {
            let names = [
                (Protocols::AOE, "AoE"),
                (Protocols::EOE, "EoE"),
                (Protocols::COE, "CoE"),
                (Protocols::FOE, "FoE"),
                (Protocols::SOE, "SoE"),
                (Protocols::VOE, "VoE"),
            ];
            let named = names.iter().filter(|(bit, _)| protocols.has(*bit));
            let named: Vec<&str> = named.map(|(_, name)| *name).collect();
            if named.is_empty() {
                "none".to_owned()
            } else {
                named.join(" ")
            }
        },
    );
    list.field(
        DifferenceKind::Description,
        "EEPROM size",
        [&a.byte_size, &b.byte_size],
        |bytes| format!("{bytes} bytes"),
    );
}

fn general(list: &mut List, a: Option<&General>, b: Option<&General>) {
    let (Some(a), Some(b)) = (a, b) else {
        let show = |general: Option<&General>| {
            if general.is_some() { "present" } else { "none" }.to_owned()
        };
        if a.is_some() != b.is_some() {
            list.add(
                DifferenceKind::Behaviour,
                "general category",
                show(a),
                show(b),
            );
        }
        return;
    };
    list.text("group", [&a.group, &b.group]);
    list.text("image", [&a.image, &b.image]);
    list.text("order code", [&a.order, &b.order]);
    list.text("name", [&a.name, &b.name]);
    let bits = |byte: &u8| format!("{byte:#010b}");
    list.field(
        DifferenceKind::Behaviour,
        "CoE details",
        [&a.coe_details, &b.coe_details],
        bits,
    );
    list.field(
        DifferenceKind::Behaviour,
        "FoE",
        [&a.foe, &b.foe],
        bool::to_string,
    );
    list.field(
        DifferenceKind::Behaviour,
        "EoE",
        [&a.eoe, &b.eoe],
        bool::to_string,
    );
    list.field(
        DifferenceKind::Behaviour,
        "general flags",
        [&a.flags, &b.flags],
        bits,
    );
    list.field(
        DifferenceKind::Description,
        "E-bus current",
        [&a.ebus_ma, &b.ebus_ma],
        |current| format!("{current} mA"),
    );
    list.field(
        DifferenceKind::Behaviour,
        "ports",
        [&a.ports, &b.ports],
        |ports| format!("0x{ports:04x}"),
    );
    list.field(
        DifferenceKind::Behaviour,
        "identification address",
        [&a.identification_address, &b.identification_address],
        |address| format!("0x{address:04x}"),
    );
}

fn pdos(list: &mut List, kind: &str, expected: &[SiiPdo], found: &[SiiPdo]) {
    let of = |list: &[SiiPdo], index| list.iter().position(|pdo: &SiiPdo| pdo.index == index);
    for a in expected {
        let name = format!("{kind} 0x{:04x}", a.index);
        match of(found, a.index).and_then(|at| found.get(at)) {
            Some(b) => pdo(list, &name, a, b),
            None => list.add(
                DifferenceKind::Behaviour,
                name,
                format!("{} bits", a.bit_len()),
                "none".into(),
            ),
        }
    }
    for b in found.iter().filter(|b| of(expected, b.index).is_none()) {
        let name = format!("{kind} 0x{:04x}", b.index);
        list.add(
            DifferenceKind::Behaviour,
            name,
            "none".into(),
            format!("{} bits", b.bit_len()),
        );
    }
    let order = |list: &[SiiPdo]| list.iter().map(|pdo| pdo.index).collect::<Vec<u16>>();
    let (a, b) = (order(expected), order(found));
    let mut sorted = [a.clone(), b.clone()];
    sorted.iter_mut().for_each(|list| list.sort_unstable());
    if a != b && sorted[0] == sorted[1] {
        let show = |list: Vec<u16>| {
            let list: Vec<String> = list.iter().map(|index| format!("0x{index:04x}")).collect();
            list.join(" ")
        };
        list.add(
            DifferenceKind::Behaviour,
            format_args!("order of {kind}s"),
            show(a),
            show(b),
        );
    }
}

fn pdo(list: &mut List, name: &str, a: &SiiPdo, b: &SiiPdo) {
    let sm = |sm: &Option<u8>| sm.map_or_else(|| "not assigned".to_owned(), |sm| sm.to_string());
    list.text(format_args!("{name} / name"), [&a.name, &b.name]);
    list.field(
        DifferenceKind::Behaviour,
        format_args!("{name} / SyncManager"),
        [&a.sm, &b.sm],
        sm,
    );
    list.field(
        DifferenceKind::Behaviour,
        format_args!("{name} / flags"),
        [&a.flags, &b.flags],
        |flags| format!("0x{flags:04x}"),
    );
    list.field(
        DifferenceKind::Behaviour,
        format_args!("{name} / synchronisation"),
        [&a.synchronization, &b.synchronization],
        u8::to_string,
    );
    for n in 0..a.entries.len().max(b.entries.len()) {
        let what = format!("{name} / entry {}", n + 1);
        let (Some(x), Some(y)) = (a.entries.get(n), b.entries.get(n)) else {
            let show = |entry: Option<&super::SiiEntry>| {
                entry.map_or_else(|| "none".to_owned(), |e| mapping(e.index, e.sub, e.bit_len))
            };
            list.add(
                DifferenceKind::Behaviour,
                what,
                show(a.entries.get(n)),
                show(b.entries.get(n)),
            );
            continue;
        };
        let mapped = |e: &super::SiiEntry| mapping(e.index, e.sub, e.bit_len);
        if mapped(x) != mapped(y) {
            list.add(DifferenceKind::Behaviour, &what, mapped(x), mapped(y));
        }
        list.text(format_args!("{what} / name"), [&x.name, &y.name]);
        list.field(
            DifferenceKind::Description,
            format_args!("{what} / data type"),
            [&x.data_type, &y.data_type],
            |code| format!("0x{code:02x}"),
        );
        list.field(
            DifferenceKind::Description,
            format_args!("{what} / flags"),
            [&x.flags, &y.flags],
            |flags| format!("0x{flags:04x}"),
        );
    }
}

fn mapping(index: u16, sub: u8, bits: u8) -> String {
    if index == 0 {
        format!("gap of {bits} bits")
    } else {
        format!("{}, {bits} bits", address(index, sub))
    }
}

fn dc(list: &mut List, expected: &[SiiDc], found: &[SiiDc]) {
    for n in 0..expected.len().max(found.len()) {
        let what = format!("DC mode {n}");
        let (Some(a), Some(b)) = (expected.get(n), found.get(n)) else {
            let show = |mode: Option<&SiiDc>| {
                mode.map_or_else(|| "none".to_owned(), |mode| format!("{:?}", mode.name))
            };
            list.add(
                DifferenceKind::Behaviour,
                what,
                show(expected.get(n)),
                show(found.get(n)),
            );
            continue;
        };
        list.text(format_args!("{what} / name"), [&a.name, &b.name]);
        list.text(
            format_args!("{what} / description"),
            [&a.description, &b.description],
        );
        let mut number = |field: &str, a: i64, b: i64| {
            list.field(
                DifferenceKind::Behaviour,
                format_args!("{what} / {field}"),
                [&a, &b],
                i64::to_string,
            );
        };
        number("SYNC0 cycle", a.cycle0_ns.into(), b.cycle0_ns.into());
        number("SYNC0 shift", a.shift0_ns.into(), b.shift0_ns.into());
        number("SYNC1 shift", a.shift1_ns.into(), b.shift1_ns.into());
        number("SYNC0 factor", a.sync0_factor.into(), b.sync0_factor.into());
        number("SYNC1 factor", a.sync1_factor.into(), b.sync1_factor.into());
        list.field(
            DifferenceKind::Behaviour,
            format_args!("{what} / AssignActivate"),
            [&a.assign_activate, &b.assign_activate],
            |word| format!("0x{word:04x}"),
        );
    }
}
