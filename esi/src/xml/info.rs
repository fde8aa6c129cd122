//! `EtherCATInfo`: vendor and descriptions.

use super::cursor::{Cursor, Element};
use super::text::Names;
use super::{device, module};
use crate::error::{EsiError, EsiProblem};
use crate::model::{DeviceHeader, EsiFile, Group, Vendor};

/// Decides which devices are built; `None`: all.
pub(super) type DeviceFilter<'w> = Option<&'w dyn Fn(&DeviceHeader) -> bool>;

pub(super) fn read(
    c: &mut Cursor<'_>,
    file: &mut EsiFile,
    filter: DeviceFilter<'_>,
) -> Result<(), EsiError> {
    let root = c.root()?;
    match root.name {
        "EtherCATInfo" => info(c, &root, file, filter),
        "EtherCATModule" => modules_alone(c, &root, file, filter),
        "EtherCATInfoList" => c.children(&root, |c, el| match el.name {
            "EtherCATInfo" => info(c, el, file, filter),
            _ => Ok(()),
        }),
        other => Err(c.error_at(&root, EsiProblem::NotEsi(other.chars().take(40).collect()))),
    }
}

fn info<'a>(
    c: &mut Cursor<'a>,
    root: &Element<'a>,
    file: &mut EsiFile,
    filter: DeviceFilter<'_>,
) -> Result<(), EsiError> {
    let first = (file.devices.len(), file.skipped.len());
    let mut vendor = None;
    c.children(root, |c, el| {
        match el.name {
            "InfoReference" => file.references.push(c.text(el)?),
            "Vendor" => vendor = Some(read_vendor(c, el)?),
            "Descriptions" => descriptions(c, el, file, filter)?,
            _ => {}
        }
        Ok(())
    })?;
    let Some(vendor) = vendor else {
        return Err(c.error_at(root, EsiProblem::Missing { what: "Vendor" }));
    };
    let built = file.devices.iter_mut().skip(first.0);
    let skipped = file.skipped.iter_mut().skip(first.1);
    let identities = built.map(|device| &mut device.identity);
    for identity in identities.chain(skipped.map(|header| &mut header.identity)) {
        identity.vendor = vendor.id;
    }
    file.vendors.push(vendor);
    Ok(())
}

fn read_vendor<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Vendor, EsiError> {
    let mut id = None;
    let mut names = Names::default();
    c.children(element, |c, el| {
        match el.name {
            "Id" => id = Some(c.number(el, "vendor id")?),
            "Name" => names.add(c, el)?,
            _ => {}
        }
        Ok(())
    })?;
    let id = id.ok_or_else(|| c.error_at(element, EsiProblem::Missing { what: "Vendor/Id" }))?;
    Ok(Vendor {
        id,
        name: names.take().into_owned(),
    })
}

fn descriptions<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    file: &mut EsiFile,
    filter: DeviceFilter<'_>,
) -> Result<(), EsiError> {
    c.children(element, |c, el| match el.name {
        "Groups" => c.children(el, |c, el| {
            if el.name == "Group" {
                file.groups.push(group(c, el)?);
            }
            Ok(())
        }),
        "Devices" => c.children(el, |c, el| {
            if el.name != "Device" {
                return Ok(());
            }
            c.devices = c.devices.saturating_add(1);
            if let Some(filter) = filter {
                let start = c.mark();
                // An unreadable header is a problem that the reader of the device reports.
                match device::header(c, el) {
                    Ok(header) if !filter(&header) => {
                        file.skipped.push(header);
                        return Ok(());
                    }
                    _ => c.rewind(el, start),
                }
            }
            let read = device::read(c, el).map(|device| file.devices.push(device));
            c.leave_out_damaged(el, read)
        }),
        "Modules" => modules(c, el, file),
        _ => Ok(()),
    })
}

fn group<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Group, EsiError> {
    let mut group = Group::default();
    let mut names = Names::default();
    c.children(element, |c, el| {
        match el.name {
            "Type" => group.type_name = c.text(el)?,
            "Name" => names.add(c, el)?,
            _ => {}
        }
        Ok(())
    })?;
    group.name = names.take().into_owned();
    Ok(group)
}

fn modules<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    file: &mut EsiFile,
) -> Result<(), EsiError> {
    c.children(element, |c, el| {
        if el.name != "Module" {
            return Ok(());
        }
        one_module(c, el, file)
    })
}

fn one_module<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    file: &mut EsiFile,
) -> Result<(), EsiError> {
    let read = module::read(c, element).map(|module| file.modules.push(module));
    c.leave_out_damaged(element, read)
}

/// Reads modules directly below the root or inside `Modules`. `Vendor` is optional.
fn modules_alone<'a>(
    c: &mut Cursor<'a>,
    root: &Element<'a>,
    file: &mut EsiFile,
    filter: DeviceFilter<'_>,
) -> Result<(), EsiError> {
    c.children(root, |c, el| {
        match el.name {
            "Vendor" => file.vendors.push(read_vendor(c, el)?),
            "Module" => one_module(c, el, file)?,
            "Modules" => modules(c, el, file)?,
            "Descriptions" => descriptions(c, el, file, filter)?,
            _ => {}
        }
        Ok(())
    })
}
