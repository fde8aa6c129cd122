//! PDOs and SyncManagers.

use super::table::{At, Mutation, insert, replace, replace_in, row};

pub const MUTATIONS: &[Mutation] = &[
    row(
        "a doubled PDO index",
        |text| {
            replace_in(
                &text,
                "<RxPdo ",
                "<Index>#x1601</Index>",
                "<Index>#x1600</Index>",
            )
        },
        ("warning", At::Nth(2, "<RxPdo ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[2]",
        "described twice, first on line 8074",
    ),
    row(
        "a PDO entry without an index",
        |text| {
            replace(
                &text,
                "<Entry>\n            <Index>#x6040</Index>",
                "<Entry>",
            )
        },
        ("error", At::First("<Entry>")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]/Entry[1]",
        "Entry/Index is missing",
    ),
    row(
        "a PDO without an index",
        |text| replace_in(&text, "<RxPdo ", "<Index>#x1602</Index>", ""),
        ("error", At::Nth(3, "<RxPdo ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[3]",
        "PDO Index is missing",
    ),
    row(
        "a PDO that excludes itself",
        |text| {
            replace(
                &text,
                "<Exclude>#x1601</Exclude>",
                "<Exclude>#x1600</Exclude>",
            )
        },
        ("warning", At::Nth(1, "<RxPdo ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]",
        "excludes itself",
    ),
    row(
        "a bit length of 0",
        |text| replace(&text, "<BitLen>16</BitLen>", "<BitLen>0</BitLen>"),
        ("warning", At::First("<Entry>")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]/Entry[1]",
        "bit length of 0",
    ),
    row(
        "a bit length beyond 16 bits",
        |text| replace(&text, "<BitLen>16</BitLen>", "<BitLen>65536</BitLen>"),
        ("error", At::First("<BitLen>")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]/Entry[1]/BitLen",
        r##""65536" is not a number that fits"##,
    ),
    row(
        "a negative bit length",
        |text| replace(&text, "<BitLen>16</BitLen>", "<BitLen>-16</BitLen>"),
        ("error", At::First("<BitLen>")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]/Entry[1]/BitLen",
        r##""-16""##,
    ),
    row(
        "a bit length beyond a frame",
        |text| replace(&text, "<BitLen>16</BitLen>", "<BitLen>65535</BitLen>"),
        ("warning", At::First("<Entry>")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]/Entry[1]",
        "more than a frame carries",
    ),
    row(
        "a subindex of 256",
        |text| replace(&text, "<SubIndex>0</SubIndex>", "<SubIndex>256</SubIndex>"),
        ("error", At::First("<SubIndex>256")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]/Entry[1]/SubIndex",
        r##""256""##,
    ),
    row(
        "a PDO of a SyncManager that is not there",
        |text| {
            replace(
                &text,
                r##"<RxPdo Fixed="false" Sm="2""##,
                r##"<RxPdo Fixed="false" Sm="9""##,
            )
        },
        ("warning", At::Nth(1, "<RxPdo ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]",
        "Sm 9, and the device has 4",
    ),
    row(
        "a PDO of SyncManager 300",
        |text| {
            replace(
                &text,
                r##"<RxPdo Fixed="false" Sm="2""##,
                r##"<RxPdo Fixed="false" Sm="300""##,
            )
        },
        ("error", At::Nth(1, "<RxPdo ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]",
        r##"Sm "300""##,
    ),
    row(
        "an output PDO of an input SyncManager",
        |text| {
            replace(
                &text,
                r##"<RxPdo Fixed="false" Sm="2""##,
                r##"<RxPdo Fixed="false" Sm="3""##,
            )
        },
        ("warning", At::Nth(1, "<RxPdo ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]",
        "for Inputs and not for Outputs",
    ),
    row(
        "3000 PDOs",
        |text| {
            insert(
                &text,
                "<TxPdo ",
                &"<TxPdo><Index>#x1a00</Index></TxPdo>".repeat(3000),
            )
        },
        ("error", At::Nth(2049, "<TxPdo")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/TxPdo[2049]",
        "the PDOs of one direction exceed 2048",
    ),
    row(
        "20000 entries in a PDO",
        |text| {
            insert(
                &text,
                "<Entry>",
                &"<Entry><Index>0</Index></Entry>".repeat(20_000),
            )
        },
        ("error", At::Nth(12001, "<Entry>")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/RxPdo[1]/Entry[12001]",
        "a PDO's entries exceed 12000",
    ),
    row(
        "65535 samples of a PDO",
        |text| replace_in(&text, "#x6800000C\">", "<RxPdo ", "<RxPdo OSFac=\"65535\" "),
        ("error", At::First("<RxPdo OSFac")),
        "EtherCATInfo/Descriptions/Modules/Module[3]/RxPdo[1]",
        "65535 samples of PDO 0x1600",
    ),
    row(
        "a SyncManager without an address",
        |text| replace(&text, r##" StartAddress="#x1060""##, ""),
        ("error", At::Nth(3, "<Sm ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Sm[3]",
        "StartAddress is missing",
    ),
    row(
        "a SyncManager beyond the memory",
        |text| {
            replace(
                &text,
                r##"StartAddress="#x1060""##,
                r##"StartAddress="#xfff0""##,
            )
        },
        ("error", At::Nth(3, "<Sm ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Sm[3]",
        "does not lie in a SubDevice's memory",
    ),
    row(
        "a SyncManager at the registers",
        |text| {
            replace(
                &text,
                r##"StartAddress="#x1060""##,
                r##"StartAddress="#x0120""##,
            )
        },
        ("error", At::Nth(3, "<Sm ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Sm[3]",
        "does not lie in a SubDevice's memory",
    ),
    row(
        "SyncManagers that overlap",
        |text| {
            replace(
                &text,
                r##"StartAddress="#x10f0""##,
                r##"StartAddress="#x1062""##,
            )
        },
        ("error", At::First("<Device ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]",
        "reaches into SyncManager 3",
    ),
    row(
        "no mailbox SyncManager",
        |text| replace(&text, ">MBoxIn<", ">Inputs<"),
        ("warning", At::First("<Device ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]",
        "no Sm for both of its directions",
    ),
    row(
        "an FMMU of a SyncManager that is not there",
        |text| replace(&text, "<Fmmu>Inputs", r##"<Fmmu Sm="200">Inputs"##),
        ("warning", At::First("<Device ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Fmmu[2]",
        "Sm 200, which does not exist",
    ),
];
