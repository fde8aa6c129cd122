//! Every published EEPROM image becomes a SubDevice that a MainDevice takes from Init to Op.

use crate::common::*;
use crate::main_device;
use ecaxis_sim::{DeviceOptions, SimDevice};
use std::path::Path;

fn climb(image: &[u8]) -> Result<String, String> {
    const S: u16 = 0x1001;
    let sim = SimDevice::from_sii(image, DeviceOptions::default()).map_err(|e| e.to_string())?;
    let name = sim.name().to_owned();
    let mut bus = Bus::new(vec![sim]);
    bus.address_all();
    let (learned, mapped) = main_device::bring_up(&mut bus, S)?;
    // The MainDevice reads up to the end mark.
    let read = learned.image.len().min(image.len()) - 8;
    if learned.image[..read] != image[..read] {
        return Err("the EEPROM reads differently".into());
    }
    let (outputs, inputs) = (mapped.outputs, mapped.inputs);
    Ok(format!("{name}: {outputs} bytes out, {inputs} in"))
}

#[test]
fn every_image_reaches_op() {
    for (folder, least) in [("", 15), ("../vendor-files", 6)] {
        if fixture(Path::new(folder).join("README.md").to_str().unwrap()).is_some() {
            sweep(&fixtures().join(folder).join("sii"), least);
        }
    }
}

/// Takes a device of each image to Op.
fn sweep(folder: &Path, least: usize) {
    let mut paths = Vec::new();
    for folder in std::fs::read_dir(folder).unwrap() {
        for file in std::fs::read_dir(folder.unwrap().path()).unwrap() {
            paths.push(file.unwrap().path());
        }
    }
    paths.sort();
    let (mut count, mut problems) = (0, Vec::new());
    for path in paths {
        let image = std::fs::read(&path).unwrap();
        // One file is Intel HEX text of another.
        if image.starts_with(b":") {
            continue;
        }
        count += 1;
        match climb(&image) {
            Ok(what) => eprintln!("{what}"),
            Err(problem) => problems.push(format!("{}: {problem}", path.display())),
        }
    }
    assert!(count >= least, "{count} images");
    assert!(problems.is_empty(), "{}", problems.join("\n"));
}
