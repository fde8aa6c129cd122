//! `EtherCATInfo`: vendor and descriptions.

use super::cursor::{Cursor, Element};
use super::text::Names;
use super::{device, module};
use crate::error::{EsiError, EsiProblem};
use crate::model::{EsiFile, Vendor};

pub(super) fn read(c: &mut Cursor<'_>, file: &mut EsiFile) -> Result<(), EsiError> {
    let root = c.root()?;
    match root.name {
        "EtherCATInfo" => info(c, &root, file),
        "EtherCATInfoList" => c.children(&root, |c, el| match el.name {
            "EtherCATInfo" => info(c, el, file),
            _ => Ok(()),
        }),
        other => Err(c.error_at(&root, EsiProblem::NotEsi(other.chars().take(40).collect()))),
    }
}

fn info<'a>(c: &mut Cursor<'a>, root: &Element<'a>, file: &mut EsiFile) -> Result<(), EsiError> {
    let first = file.devices.len();
    let mut vendor = None;
    c.children(root, |c, el| {
        match el.name {
            "Vendor" => vendor = Some(read_vendor(c, el)?),
            "Descriptions" => descriptions(c, el, file)?,
            _ => {}
        }
        Ok(())
    })?;
    let Some(vendor) = vendor else {
        return Err(c.error_at(root, EsiProblem::Missing { what: "Vendor" }));
    };
    for device in file.devices.iter_mut().skip(first) {
        device.identity.vendor = vendor.id;
    }
    file.vendor = vendor;
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
        name: names.take(),
    })
}

fn descriptions<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    file: &mut EsiFile,
) -> Result<(), EsiError> {
    c.children(element, |c, el| match el.name {
        "Devices" => c.children(el, |c, el| {
            if el.name == "Device" {
                file.devices.push(device::read(c, el)?);
            }
            Ok(())
        }),
        "Modules" => c.children(el, |c, el| {
            if el.name == "Module" {
                file.modules.push(module::read(c, el)?);
            }
            Ok(())
        }),
        _ => Ok(()),
    })
}
