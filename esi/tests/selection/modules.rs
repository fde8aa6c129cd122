//! Modules in slots.

use super::*;

/// Two axes in one device: the slot's increments shift the indices of the second module.
#[test]
fn a_module_in_the_second_slot_has_shifted_indices() {
    let Some(file) = file("esi/hpmicro/ECAT_CIA402.xml") else {
        return;
    };
    let choice = SelectOptions {
        modules: &["0x319800", "0x219800"],
        cycle_ns: MS,
        ..SelectOptions::default()
    };
    let selection = choose(&file, &choice).unwrap();
    let places: Vec<_> = selection
        .modules
        .iter()
        .map(|m| (m.place, m.slot_name.as_str()))
        .collect();
    assert_eq!(places, [(0, "Axis 0"), (1, "Axis 1")]);
    let indices: Vec<u16> = selection.rx.iter().map(|pdo| pdo.index).collect();
    assert_eq!(indices, [0x1602, 0x1601 + 16]);
    let controlwords =
        [0x6040, 0x6840].map(|index| selection.layout.rx_field(index, 0).unwrap().bit_offset);
    assert_eq!(controlwords, [0, 64]);
    assert!(
        selection.dictionary.object(0x683f).is_some(),
        "0x603F + 0x800"
    );
    let modes: Vec<_> = selection
        .startup
        .iter()
        .filter(|sdo| sdo.transition == "SO")
        .map(|sdo| (sdo.index, sdo.data[0]))
        .collect();
    assert_eq!(modes, [(0x6060, 9), (0x6860, 8)]);
}

/// ETG.2000: a slot with `MinInstances="0"` may stay empty. The second slot of this vendor's device
/// is one; its objects are 0x800 later, so it holds the second axis (CiA 402-1).
#[test]
fn an_optional_slot_is_filled_if_its_axis_is_used() {
    let Some(file) = file("esi/hpmicro/ECAT_CIA402.xml") else {
        return;
    };
    let device = &file.devices[0];
    let slots = device.slots.as_ref().expect("slots");
    assert_eq!(slots.slots[1].min_instances, 0);
    let choose = |axes: &[u16], modules: &[&str]| {
        let choice = SelectOptions {
            mode: Some(Mode::Csp),
            axes,
            modules,
            cycle_ns: MS,
            ..SelectOptions::default()
        };
        choose(&file, &choice)
    };
    let places = |axes: &[u16]| -> Vec<(usize, u32)> {
        let selection = choose(axes, &[]).unwrap();
        let modules = selection.modules.iter();
        modules.map(|m| (m.place, m.ident)).collect()
    };
    assert_eq!(places(&[0]).len(), 1);
    let two = places(&[0, 1]);
    assert_eq!(two.len(), 2, "{two:?}");
    assert_eq!((two[0].1, two[1].0), (two[1].1, 1));
    // Only the second axis: the first slot needs a module all the same.
    assert_eq!(places(&[1]), two);
    // The user's own choice wins.
    assert!(choose(&[0, 1], &["0x319800", "-"]).is_err());
}

#[test]
fn a_module_that_does_not_fit_is_rejected_by_name() {
    let Some(file) = file("esi/hpmicro/ECAT_CIA402.xml") else {
        return;
    };
    let refused = |modules: &[&str]| {
        let choice = SelectOptions {
            modules,
            cycle_ns: MS,
            ..SelectOptions::default()
        };
        choose(&file, &choice).unwrap_err().to_string()
    };
    let text = refused(&["-", "-"]);
    assert!(text.contains("slot \"Axis 0\" needs a module"), "{text}");
    let text = refused(&["0x319800", "valve"]);
    assert!(
        text.contains("takes no module \"valve\"; the ESI offers"),
        "{text}"
    );
    let text = refused(&["0x319800", "-", "-"]);
    assert!(
        text.contains("3 modules are listed, there are 2 places"),
        "{text}"
    );
}
