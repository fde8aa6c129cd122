//! Slots, modules and dictionaries.

use super::table::{
    At, Mutation, insert, instances, large_module, long_type, replace, replace_in, row, slots,
};

pub const MUTATIONS: &[Mutation] = &[
    row(
        "a slot of an unknown module",
        |text| {
            replace(
                &text,
                r##"<ModuleIdent Default="1">#x6800000C"##,
                r##"<ModuleIdent Default="1">#xDEADBEEF"##,
            )
        },
        ("error", At::First("<Slot ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Slots/Slot[1]",
        "module 0xdeadbeef, which neither",
    ),
    row(
        "a module without an identity",
        |text| replace(&text, r##"<Type ModuleIdent="#x6300000C">"##, "<Type>"),
        ("error", At::Nth(2, "<Module>")),
        "EtherCATInfo/Descriptions/Modules/Module[2]",
        "ModuleIdent is missing",
    ),
    row(
        "a doubled module",
        |text| {
            replace(
                &text,
                r##"<Type ModuleIdent="#x6300000C">"##,
                r##"<Type ModuleIdent="#x6100000C">"##,
            )
        },
        ("warning", At::Nth(2, "<Module>")),
        "EtherCATInfo/Descriptions/Modules/Module[2]",
        "described twice; the one on line 8271 is taken",
    ),
    row(
        "65535 instances of a slot",
        |text| instances(&text, "65535"),
        ("warning", At::First("<Slots ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Slots",
        "65535 places for modules; 0xF030 lists 254",
    ),
    row(
        "4294967296 instances of a slot",
        |text| instances(&text, "4294967296"),
        ("error", At::First("<Slot ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Slots/Slot[1]",
        r##"MinInstances "4294967296""##,
    ),
    row(
        "254 slots of large dictionaries",
        |text| slots(&large_module(&text, 200), 254),
        ("error", At::First("<Slots ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Slots",
        "in the 254 places of",
    ),
    row(
        "254 slots of dictionaries just below the bound",
        |text| slots(&large_module(&text, 5), 254),
        ("warning", At::First("<Slots ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Slots",
        "255 places for modules; 0xF030 lists 254",
    ),
    row(
        "100000 slots",
        |text| slots(&text, 100_000),
        ("warning", At::First("<Slots ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Slots",
        "100001 places for modules",
    ),
    row(
        "65535 instances of large dictionaries",
        |text| instances(&large_module(&text, 200), "65535"),
        ("error", At::First("<Slots ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Slots",
        "in the 254 places of",
    ),
    row(
        "an absurd increment",
        |text| {
            replace(
                &text,
                r##"SlotPdoIncrement="1""##,
                r##"SlotPdoIncrement="#x10000""##,
            )
        },
        ("error", At::First("<Slots ")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Slots",
        r##"SlotPdoIncrement "#x10000""##,
    ),
    row(
        "InitCmd data that is not hexadecimal",
        |text| replace_in(&text, "<InitCmd>", "<Data>01", "<Data>0x1"),
        ("error", At::First("<Data>0x1")),
        "EtherCATInfo/Descriptions/Modules/Module[1]/Mailbox/CoE/InitCmd[1]/Data",
        "not a sequence of hexadecimal bytes",
    ),
    row(
        "an object of 4294967295 bits",
        |text| {
            replace(
                &text,
                "<Objects>",
                "<Objects><Object><Index>#x4000</Index><Type>HUGE</Type><BitSize>4294967295</BitSize></Object>",
            )
        },
        ("error", At::First("<Object><Index>#x4000")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary",
        "an object's bits exceed 8388608",
    ),
    row(
        "1000 objects of a megabyte",
        |text| {
            insert(&text, "<Object>", &"<Object><Index>#x4000</Index><Type>HUGE</Type><BitSize>8388608</BitSize></Object>".repeat(1000))
        },
        ("refused", At::Nth(32, "<Object><Index>#x4000")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary",
        "the objects' bytes exceed 33554432",
    ),
    row(
        "a doubled object",
        |text| {
            insert(
                &text,
                "<Object>",
                "<Object><Index>#x1000</Index><Type>UDINT</Type><BitSize>32</BitSize></Object>",
            )
        },
        ("warning", At::Nth(2, "<Object>")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary/Objects/Object[2]",
        "object 0x1000 is described twice",
    ),
    row(
        "an array of 4294967295 elements",
        |text| {
            replace(
                &text,
                "<LBound>1</LBound>\n                  <Elements>4<",
                "<LBound>1</LBound>\n                  <Elements>4294967295<",
            )
        },
        ("warning", At::Before("<Index>#x1C00</Index>", "<Object>")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary",
        "an array of 4294967295 elements; there are 255 subindices",
    ),
    row(
        "an array of 4294967296 elements",
        |text| replace(&text, "<Elements>16<", "<Elements>4294967296<"),
        ("error", At::First("<Elements>")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary/DataTypes/DataType[7]/ArrayInfo/Elements",
        r##"Elements "4294967296""##,
    ),
    row(
        "data types made of each other",
        |text| {
            insert(
                &text,
                "<DataType>",
                "<DataType><Name>ROUND</Name><BaseType>ABOUT</BaseType></DataType><DataType><Name>ABOUT</Name><BaseType>ROUND</BaseType></DataType>",
            )
        },
        ("warning", At::First("<DataType><Name>ABOUT")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary/DataTypes",
        r##"type "ABOUT" is made of itself"##,
    ),
    row(
        "a type name of 2 MB in an array",
        |text| long_type(&text),
        ("refused", At::First("<Object><Index>#x4000")),
        "EtherCATInfo/Descriptions/Devices/Device[1]/Profile/Dictionary",
        "the objects' bytes exceed 33554432",
    ),
];
