//! The descriptions of the devices: ESI files, and EEPROM images of devices without one.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ecaxis_esi as esi;
use toml::Spanned;

use crate::config::fields::KeyExt;
use crate::config::problem::{Problems, Span, suggestion};
use crate::config::raw::RawDevice;
use crate::esi_library::{self, Library, LoadError, SiiImage};
use crate::file::unreadable;
use crate::parameters::kept::KeptParameters;

/// Data shared by all devices: the ESI folder, the files read so far, and the cycle.
pub(crate) struct EsiFiles<'f> {
    folder: &'f Path,
    /// What the machine file says of its devices; other devices of an ESI file are not built.
    queries: Vec<OwnedQuery>,
    /// The cycle in ns and its place in the file; `None` if the cycle is invalid.
    pub cycle: Option<(u64, Span)>,
    /// The files; `None`: could not be read, which has been reported.
    files: BTreeMap<PathBuf, Option<Arc<esi::EsiFile>>>,
    folders: BTreeMap<PathBuf, Option<Library>>,
    images: BTreeMap<PathBuf, Option<Arc<SiiImage>>>,
}

impl<'f> EsiFiles<'f> {
    pub fn new(folder: &'f Path, devices: &[RawDevice], cycle: Option<(u64, Span)>) -> Self {
        Self {
            folder,
            queries: devices.iter().map(OwnedQuery::new).collect(),
            cycle,
            files: BTreeMap::new(),
            folders: BTreeMap::new(),
            images: BTreeMap::new(),
        }
    }

    /// Returns the folder of the machine file.
    pub fn folder(&self) -> &'f Path {
        self.folder
    }

    /// Returns the EEPROM image that `sii` names.
    pub fn image(&mut self, raw: &RawDevice, p: &mut Problems<'_>) -> Option<Arc<SiiImage>> {
        let name = raw.sii.as_ref()?;
        let path = self.folder.join(name.get_ref());
        let image = match self.images.get(&path) {
            Some(known) => known.clone(),
            None => {
                let read = esi_library::load_sii(&path, &mut p.files);
                let read = read.map_err(|e| refused(e, ".sii"));
                let read = read.map_err(|(message, hint)| p.add_hint(name.span(), message, hint));
                let image = read.ok().map(Arc::new);
                self.images.insert(path, image.clone());
                image
            }
        }?;
        // Without the damaged part, the process data would be others than the device has.
        if let (None, Some(damage)) = (&raw.esi, image.sii.damage.first()) {
            let message = format!("damaged EEPROM image {}: {damage}", image.path.display());
            let hint = "get the ESI file of the device from its vendor and name it with `esi`";
            p.add_hint(name.span(), message, hint);
            return None;
        }
        Some(image)
    }

    /// Returns the parameter file that `parameters` names.
    pub fn parameters(
        &self,
        raw: &RawDevice,
        device: Option<&esi::Device>,
        p: &mut Problems<'_>,
    ) -> Option<Option<Arc<KeptParameters>>> {
        let Some(name) = &raw.parameters else {
            return Some(None);
        };
        let path = self.folder.join(name.get_ref());
        let read = KeptParameters::read(&path, device?, &mut p.files);
        let read = read.map_err(|(message, hint)| p.add_hint(name.span(), message, hint));
        Some(Some(Arc::new(read.ok()?)))
    }

    /// Returns the file that `esi` names, or the matching file in the folder that it names. Without
    /// `esi`, the EEPROM image describes the device.
    pub fn file(
        &mut self,
        raw: &RawDevice,
        image: Option<&SiiImage>,
        p: &mut Problems<'_>,
    ) -> Option<(PathBuf, Arc<esi::EsiFile>)> {
        let Some(name) = &raw.esi else {
            let written = &raw.written;
            if !written.has("esi") && !written.has("sii") && !written.unknown {
                let message = "`esi` is missing in [[device]]";
                let hint = "add `esi = \"esi/EPOS4.xml\"`, or `sii` with the EEPROM image of a device without an ESI file";
                p.add_hint(raw.span.clone(), message, hint);
            }
            let image = image?;
            if let Some(known) = self.files.get(&image.path) {
                return known.clone().map(|file| (image.path.clone(), file));
            }
            let file = Arc::new(image.sii.to_esi_file());
            self.files
                .insert(image.path.clone(), Some(Arc::clone(&file)));
            return Some((image.path.clone(), file));
        };
        let mut path = self.folder.join(name.get_ref());
        if path.is_dir() {
            path = self.in_folder(&path, raw, name, p)?;
        }
        if let Some(known) = self.files.get(&path) {
            return known.clone().map(|file| (path, file));
        }
        let wanted = |header: &esi::DeviceHeader| {
            let fits = |query: &OwnedQuery| {
                let query = query.borrow();
                query.matches(header.identity, &header.type_name, &header.name)
            };
            self.queries.iter().any(fits)
        };
        let read =
            esi_library::load_with(&path, &wanted, &mut p.files).map_err(|e| refused(e, ".xml"));
        let file = match read {
            Ok(file) => Some(Arc::new(file)),
            Err((message, hint)) => {
                p.add_hint(name.span(), message, hint);
                None
            }
        };
        self.files.insert(path.clone(), file.clone());
        file.map(|file| (path, file))
    }

    /// Returns the file of a folder that describes `type`, `vendor`, `product` and `revision`.
    fn in_folder(
        &mut self,
        folder: &Path,
        raw: &RawDevice,
        name: &Spanned<String>,
        p: &mut Problems<'_>,
    ) -> Option<PathBuf> {
        if !self.folders.contains_key(folder) {
            let cache = esi_library::cache_file(folder);
            let opened = Library::open(folder, cache.as_deref());
            let opened = opened.map_err(|e| p.add(name.span(), e.to_string())).ok();
            self.folders.insert(folder.to_owned(), opened);
        }
        let known = self.folders.get(folder)?.as_ref()?;
        let type_name = raw.type_name.as_ref().map(|t| t.get_ref().trim());
        let fits = |e: &&esi_library::Entry| {
            raw.vendor.value().is_none_or(|vendor| vendor == e.vendor)
                && raw
                    .product
                    .value()
                    .is_none_or(|product| product == e.product)
                && raw
                    .revision
                    .value()
                    .is_none_or(|revision| revision == e.revision)
                && type_name.is_none_or(|name| {
                    e.type_name.eq_ignore_ascii_case(name) || e.name.eq_ignore_ascii_case(name)
                })
        };
        // The newest of several revisions in several files.
        let newest = known
            .entries()
            .iter()
            .filter(fits)
            .max_by_key(|e| e.revision);
        let Some(newest) = newest else {
            let message = format!(
                "none of the {} devices described in {} fits `type`, `vendor`, `product` and `revision`",
                known.entries().len(),
                folder.display()
            );
            let names = known.entries().iter().map(|e| e.type_name.as_str());
            let hint = match type_name {
                Some(name) => suggestion(name, names, "devices described there"),
                None => format!("`ecaxis esi list {}` shows them", folder.display()),
            };
            p.add_hint(name.span(), message, hint);
            return None;
        };
        let product = (newest.vendor, newest.product);
        let other = known
            .entries()
            .iter()
            .filter(fits)
            .find(|e| (e.vendor, e.product) != product);
        if let Some(other) = other {
            let message = format!(
                "{} describes several devices that fit: {} in {}, {} in {}, perhaps more",
                folder.display(),
                newest.type_name,
                newest.file.display(),
                other.type_name,
                other.file.display()
            );
            p.add_hint(
                name.span(),
                message,
                "say which with `type`, or with `vendor` and `product`",
            );
            return None;
        }
        Some(folder.join(&newest.file))
    }
}

/// Returns the problem with a file, and a hint. `extension`: of files that could have been meant.
fn refused(error: LoadError, extension: &str) -> (String, String) {
    match error {
        LoadError::Read { path, source } => {
            let hint = match source.kind() {
                std::io::ErrorKind::NotFound => neighbours(&path, extension),
                _ => "look at the file's permissions".to_owned(),
            };
            (unreadable(&path, &source), hint)
        }
        LoadError::Signature(error) => (error.to_string(), error.hint().to_owned()),
        LoadError::Esi { .. } => (
            error.to_string(),
            "the file is damaged or is not an ESI file".to_owned(),
        ),
        LoadError::Sii { .. } => (
            error.to_string(),
            "`ecaxis eeprom read` and `ecaxis scan --write` save the image of a device".to_owned(),
        ),
    }
}

/// Returns files that could have been meant.
fn neighbours(path: &Path, extension: &str) -> String {
    let folder = path
        .parent()
        .filter(|p| !p.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    let Ok(entries) = std::fs::read_dir(folder) else {
        return format!(
            "paths are relative to the machine file, and there is no folder {}",
            folder.display()
        );
    };
    let mut names: Vec<String> = entries
        .flatten()
        .filter_map(|e| e.file_name().into_string().ok())
        .filter(|n| n.to_ascii_lowercase().ends_with(extension))
        .collect();
    names.sort();
    names.truncate(20);
    if names.is_empty() {
        return format!("there is no {extension} file in {}", folder.display());
    }
    let word = path.file_name().unwrap_or_default().to_string_lossy();
    let what = match extension {
        ".xml" => format!("ESI files in {}", folder.display()),
        _ => format!("{extension} files in {}", folder.display()),
    };
    suggestion(&word, names.iter().map(String::as_str), &what)
}

/// `type`, `product` and `revision` of a device.
pub(super) struct OwnedQuery {
    name: Option<String>,
    product: Option<u32>,
    revision: Option<u32>,
}

impl OwnedQuery {
    pub fn new(raw: &RawDevice) -> Self {
        Self {
            name: raw.type_name.as_ref().map(|n| n.get_ref().clone()),
            product: raw.product.value(),
            revision: raw.revision.value(),
        }
    }

    pub fn borrow(&self) -> esi::DeviceQuery<'_> {
        esi::DeviceQuery {
            name: self.name.as_deref(),
            product: self.product,
            revision: self.revision,
        }
    }
}
