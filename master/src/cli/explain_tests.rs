use super::super::tables::{short_name, value};
use super::*;

#[test]
fn bytes_on_the_wire_as_counted_by_hand() {
    for (axes, bytes) in [(8, 168), (32, 456), (100, 1272)] {
        let plan = image::plan(&vec![(12, 12); axes]).unwrap();
        let frames = frame_bytes(&plan, true);
        assert_eq!(
            frames.iter().sum::<usize>(),
            bytes + AL_STATUS,
            "{axes} axes"
        );
        assert_eq!(frames.len(), 1);
    }
    let idle = frame_bytes(&image::plan(&[]).unwrap(), false);
    assert_eq!(idle, [84]);
}

#[test]
fn an_entrys_name_stands_for_itself() {
    for (name, short) in [
        ("RxPDO assignment / Assigned PDOs", "Assigned PDOs"),
        ("RxPDO / SubIndex 001", "RxPDO / SubIndex 001"),
        ("Modes of operation", "Modes of operation"),
    ] {
        assert_eq!(short_name(name), short);
    }
}

#[test]
fn fits_a_terminal_and_tells_what_is_assumed() {
    let configs = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
    let demo = std::fs::read_to_string(configs.join("demo.toml")).unwrap();
    let explained = |text: &str| {
        let machine = config::parse(&configs.join("demo.toml"), text).unwrap();
        let mut out = String::new();
        explain(&machine, &mut out).unwrap();
        out.replace(&configs.display().to_string(), "configs")
    };
    let text = explained(&demo);
    let wide: Vec<&str> = text.lines().filter(|l| l.chars().count() > 100).collect();
    assert!(wide.is_empty(), "{wide:#?}");
    assert!(text.contains("rpm (0x60A9 in the ESI)"));
    assert!(!text.contains("assumed"));
    let said = demo.replace("encoder ", "velocity_unit = \"rpm\"\nencoder ");
    assert!(explained(&said).contains("rpm (assumed, as `velocity_unit` says)"));
}

#[test]
fn values_read_as_numbers() {
    assert_eq!(value(&[0x10, 0x27]), "0x2710");
    assert_eq!(value(&[1; 9]), "01 01 01 01 01 01 01 01 01");
    assert_eq!(value(&[]), "");
}
