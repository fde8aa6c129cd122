//! The file as a whole: truncation, roots, encodings, numbers, devices, clocks.

use super::table::{At, Mutation, bomb, cut, cut_first, doubled, insert, replace, replace_in, row};

pub const MUTATIONS: &[Mutation] = &[
    row(
        "cut inside the XML declaration",
        |text| cut(text, r##" encoding="iso"##),
        ("refused", At::First("<?xml")),
        "(file)",
        "ends inside a tag",
    ),
    row(
        "cut inside the vendor's id",
        |text| cut(text, "000000FB"),
        ("refused", At::First("<Id>")),
        "EtherCATInfo/Vendor/Id",
        "ends inside <Id>",
    ),
    row(
        "cut inside a start tag",
        |text| cut(text, r##" DefaultSize="48" StartAddress="#x1000""##),
        ("refused", At::First("<Sm MinSize")),
        "EtherCATInfo/Descriptions/Devices/Device[1]",
        "ends inside a tag",
    ),
    row(
        "cut inside the data types",
        |text| cut_first(text, "<BitSize>40"),
        (
            "refused",
            At::First("<DataType>\n                <Name>STRING(5)"),
        ),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary/DataTypes/DataType[3]",
        "ends inside <DataType>",
    ),
    row(
        "cut inside the last module",
        |text| cut(text, r##"#x6A00000C">"##),
        ("refused", At::Last("<Type ModuleIdent")),
        "EtherCATInfo/Descriptions/Modules/Module[5]",
        "ends inside a tag",
    ),
    row(
        "cut before the root ends",
        |text| cut(text, "</EtherCATInfo>"),
        ("refused", At::First("<EtherCATInfo ")),
        "EtherCATInfo",
        "ends inside <EtherCATInfo>",
    ),
    row(
        "an end tag is missing",
        |text| replace(&text, "</GroupType>\n", "\n"),
        ("refused", At::First("</Device>")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/GroupType",
        "expected `</GroupType>`",
    ),
    row(
        "nothing at all",
        |_| String::new(),
        ("refused", At::First("")),
        "(file)",
        "no XML element",
    ),
    row(
        "a comment that never ends",
        |text| replace(&text, "<Fmmu>Outputs", "<!- - <Fmmu>Outputs"),
        ("refused", At::First("<!- -")),
        "EtherCATInfo/Descriptions/Devices/Device[1]",
        "ends inside a tag or a comment",
    ),
    row(
        "another root",
        |text| text.replace("EtherCATInfo", "EtherCATConfig"),
        ("refused", At::First("<EtherCATConfig ")),
        "EtherCATConfig",
        "root element is <EtherCATConfig>",
    ),
    row(
        "no vendor",
        |text| text.replace("Vendor>", "Seller>"),
        ("refused", At::First("<EtherCATInfo ")),
        "EtherCATInfo",
        "Vendor is missing",
    ),
    row(
        "a product code that is not a number",
        |text| {
            replace(
                &text,
                r##"ProductCode="#x69500000""##,
                r##"ProductCode="#x6950000G""##,
            )
        },
        ("error", At::First("<Type ProductCode")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Type",
        r##"ProductCode "#x6950000G""##,
    ),
    row(
        "a vendor id of a million digits",
        |text| replace(&text, "#x000000FB", &"9".repeat(1_000_000)),
        ("refused", At::First("<Id>")),
        "EtherCATInfo/Vendor/Id",
        r##"vendor id "99999999"##,
    ),
    row(
        "a cycle beyond 64 bits",
        |text| {
            replace_in(
                &text,
                "<OpMode>",
                "<CycleTimeSync0 Factor=\"1\">0",
                "<CycleTimeSync0 Factor=\"1\">99999999999999999999",
            )
        },
        ("error", At::First("<CycleTimeSync0")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Dc/OpMode[1]/CycleTimeSync0",
        "time in nanoseconds",
    ),
    row(
        "a cycle beyond its register",
        |text| {
            replace_in(
                &text,
                "<OpMode>",
                "<CycleTimeSync0 Factor=\"1\">0",
                "<CycleTimeSync0 Factor=\"1\">4294967296",
            )
        },
        ("error", At::First("<Device ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]",
        "a SYNC0 cycle that does not fit",
    ),
    row(
        "a doubled device",
        |text| doubled(&text, 1),
        ("warning", At::Nth(2, "<Device ")),
        "EtherCATInfo/Descriptions/Devices/Device[2]",
        "described twice, first on line 18",
    ),
    row(
        "5000 doubled devices with 254 places each",
        |text| doubled(&text, 5000),
        ("warning", At::Last("<Device ")),
        "EtherCATInfo/Descriptions/Devices",
        "not all layouts were tried",
    ),
    row(
        "a device without a type",
        |text| {
            replace(
                &text,
                r##"<Type ProductCode="#x69500000" RevisionNo="#x01700000">EPOS4</Type>"##,
                "",
            )
        },
        ("error", At::First("<Device ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]",
        "Device/Type is missing",
    ),
    row(
        "entities that multiply",
        |text| bomb(&text),
        ("warning", At::First("<Name>EPOS4 Micro")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Name",
        "entity &lol9; is not expanded",
    ),
    row(
        "an unknown entity in an attribute",
        |text| replace(&text, r##"Physics="YY""##, r##"Physics="&lol;""##),
        ("error", At::First("<Device ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]",
        "attribute Physics",
    ),
    row(
        "100 levels deep",
        |text| {
            insert(
                &text,
                "<GroupType>",
                &(0..100).map(|n| format!("<level{n}>")).collect::<String>(),
            )
        },
        ("error", At::First("<level59>")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/level0/level1/level2/level3/level4/level5/level6/level7/level8/level9/level10/level11/level12/level13/level14/level15/level16/level17/level18/level19/level20/level21/level22/level23/level24/level25/level26/level27/level28/level29/level30/level31/level32/level33/level34/level35/level36/level37/level38/level39/level40/level41/level42/level43/level44/level45/level46/level47/level48/level49/level50/level51/level52/level53/level54/level55/level56/level57/level58/level59",
        "nested deeper than 64",
    ),
    row(
        "a wrong encoding label",
        |text| {
            replace(
                &text,
                r##"encoding="iso-8859-1""##,
                r##"encoding="klingon-8""##,
            )
        },
        ("warning", At::First("<?xml")),
        "EtherCATInfo",
        "encoding \"klingon-8\" is not supported",
    ),
    row(
        "UTF-16 on the label alone",
        |text| {
            replace(
                &text,
                r##"encoding="iso-8859-1""##,
                r##"encoding="UTF-16""##,
            )
        },
        ("warning", At::First("<?xml")),
        "EtherCATInfo",
        "encoding \"utf-16\" is not supported",
    ),
    row(
        "UTF-8 on the label alone",
        |text| {
            replace(&text, "encoding=\"iso-8859-1\"", "encoding=\"utf-8\"")
                .replace("<Name>EPOS4 Micro", "<Name>\u{b5}POS4")
        },
        ("warning", At::First("\u{b5}POS4")),
        "EtherCATInfo",
        "is not UTF-8",
    ),
    row(
        "a NUL in a name",
        |text| replace(&text, "<Name>EPOS4 Micro", "<Name>EPOS4\0Micro"),
        ("warning", At::First("\0Micro")),
        "EtherCATInfo",
        "a NUL character",
    ),
    row(
        "200000 element names",
        |text| {
            insert(
                &text,
                "<GroupType>",
                &(0..200_000).map(|n| format!("<e{n}/>")).collect::<String>(),
            )
            .replace("#x69500000", "#x")
        },
        ("error", At::First("<Type ProductCode")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Type",
        "ProductCode \"#x\"",
    ),
];
