//! Additional information for an analysis: a machine file and ESI files.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use ecaxis_axis::Scale;
use ecaxis_esi::{self as esi, Layout};

use ecaxis_master::config::{Machine, sim::bus_order};
use ecaxis_master::esi_library::{self, Library, RevisionMatch};

/// The expected device at a position.
#[derive(Debug, Clone)]
struct Expected {
    name: String,
    product: u32,
    layout: Arc<Layout>,
    /// The axes: number in the drive, index in the machine, scale, unit.
    axes: Vec<(u16, usize, (Scale, String))>,
}

/// Names, layouts and units that a recording does not contain.
#[derive(Debug, Default)]
pub struct Context {
    expected: Vec<Expected>,
    library: Option<Library>,
    /// Cached descriptions by vendor, product and revision.
    read: HashMap<(u32, u32, u32), Option<Described>>,
}

#[derive(Debug, Clone)]
struct Described {
    type_name: String,
    layout: Option<Arc<Layout>>,
}

impl Context {
    /// Adds the devices of a machine file: names, process data, units.
    #[must_use]
    pub fn with_machine(mut self, machine: &Machine) -> Self {
        let of = |device: &&ecaxis_master::config::DeviceConfig| Expected {
            name: device.name.clone(),
            product: device.device.identity.product,
            layout: Arc::new(device.selection.layout.clone()),
            axes: machine
                .axes
                .iter()
                .enumerate()
                .filter(|(_, axis)| {
                    machine.devices[axis.device].name == device.name && axis.node.is_none()
                })
                .map(|(n, axis)| (axis.number, n, (axis.config.scale, axis.unit.clone())))
                .collect(),
        };
        self.expected = bus_order(&machine.devices).iter().map(of).collect();
        self
    }

    /// Adds ESI files, for devices whose PDO mapping the recording does not show.
    #[must_use]
    pub fn with_library(mut self, library: Library) -> Self {
        self.library = Some(library);
        self
    }

    /// Returns the machine file's device at a position if the product matches or is unknown.
    fn expected(&self, position: Option<u16>, product: Option<u32>) -> Option<&Expected> {
        let expected = self.expected.get(usize::from(position?))?;
        product
            .is_none_or(|p| p == expected.product)
            .then_some(expected)
    }

    /// Returns the name in the machine file.
    #[must_use]
    pub fn name(&self, position: Option<u16>, product: Option<u32>) -> Option<&str> {
        self.expected(position, product)
            .map(|expected| &*expected.name)
    }

    /// Returns the units of an axis of a drive, counted from 0, in the machine file.
    #[must_use]
    pub fn axis(
        &self,
        position: Option<u16>,
        product: Option<u32>,
        number: usize,
    ) -> Option<&(Scale, String)> {
        let axes = &self.expected(position, product)?.axes;
        let own = axes.iter().find(|(own, ..)| usize::from(*own) == number);
        own.map(|(.., units)| units)
    }

    /// Returns the index of an axis of a drive in the machine file.
    #[must_use]
    pub fn axis_index(
        &self,
        position: Option<u16>,
        product: Option<u32>,
        number: usize,
    ) -> Option<usize> {
        let axes = &self.expected(position, product)?.axes;
        let own = axes.iter().find(|(own, ..)| usize::from(*own) == number);
        own.map(|(_, index, _)| *index)
    }

    fn described(&mut self, vendor: u32, product: u32, revision: u32) -> Option<&Described> {
        let library = self.library.as_ref()?;
        let key = (vendor, product, revision);
        let described = self.read.entry(key);
        described.or_insert_with(|| describe(library, key)).as_ref()
    }

    /// Returns the type of a device in the ESI files.
    pub fn type_name(&mut self, vendor: u32, product: u32, revision: u32) -> Option<String> {
        self.described(vendor, product, revision)
            .map(|found| found.type_name.clone())
    }

    /// Returns the layout from the machine file, else the default layout of the ESI.
    pub fn layout(
        &mut self,
        position: Option<u16>,
        vendor: Option<u32>,
        product: Option<u32>,
        revision: Option<u32>,
    ) -> Option<Arc<Layout>> {
        if let Some(expected) = self.expected(position, product) {
            return Some(Arc::clone(&expected.layout));
        }
        self.described(vendor?, product?, revision.unwrap_or(0))?
            .layout
            .clone()
    }
}

fn describe(library: &Library, (vendor, product, revision): (u32, u32, u32)) -> Option<Described> {
    let identity = esi::Identity {
        vendor,
        product,
        revision,
    };
    let entry = library
        .find(identity, RevisionMatch::Newer)
        .or_else(|| library.find(identity, RevisionMatch::HighWord))?;
    let is_described = |device: &esi::DeviceHeader| {
        (device.identity.product, device.identity.revision) == (entry.product, entry.revision)
    };
    let file = esi_library::load(&library.folder().join(&entry.file), &is_described).ok()?;
    let device = file.devices.first()?;
    let choice = esi::SelectOptions::default();
    let layout = esi::select(&file, device, &choice).ok();
    Some(Described {
        type_name: entry.type_name.clone(),
        layout: layout.map(|selection| Arc::new(selection.layout)),
    })
}

/// Opens a library of a folder or a file with the cache of `ecaxis esi`.
///
/// # Errors
/// Fails if it cannot be read.
pub fn library(path: &Path) -> Result<Library, esi_library::LoadError> {
    if path.is_dir() {
        Library::open(path, esi_library::cache_file(path).as_deref())
    } else {
        Library::of_file(path)
    }
}
