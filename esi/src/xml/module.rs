//! `Modules/Module`: the modules for slots.

use super::cursor::{Cursor, Element};
use super::text::Names;
use super::{mailbox, pdo, profile};
use crate::error::{EsiError, EsiProblem};
use crate::model::{Direction, Module};

pub(super) fn read<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Module, EsiError> {
    let mut module = Module {
        position: c.position(element),
        path: c.path_of(element),
        ..Module::default()
    };
    let mut names = Names::default();
    let mut ident = None;
    c.children(element, |c, el| {
        match el.name {
            "Type" => {
                ident = c.attribute_number(el, "ModuleIdent")?;
                module.class = c.attribute(el, "ModuleClass")?;
                module.pdo_group = c.attribute_number(el, "ModulePdoGroup")?;
                module.type_name = c.text(el)?;
            }
            "Name" => names.add(c, el)?,
            "RxPdo" => pdo::append(c, el, Direction::Rx, &mut module.rx_pdos)?,
            "TxPdo" => pdo::append(c, el, Direction::Tx, &mut module.tx_pdos)?,
            "Pdo" => pdo::append_reference(c, el, &mut module.rx_pdos, &mut module.tx_pdos)?,
            "Mailbox" => module.init_cmds = mailbox::read(c, el)?.coe.unwrap_or_default().init_cmds,
            "DcOpModeName" => module.dc_mode = Some(c.text(el)?),
            "Profile" => {
                let profile = profile::read(c, el)?;
                module.profile = module.profile.or(profile.number);
                module.dictionary.objects.extend(profile.objects);
            }
            _ => {}
        }
        Ok(())
    })?;
    module.ident = ident.ok_or_else(|| {
        c.error_at(
            element,
            EsiProblem::Missing {
                what: "ModuleIdent",
            },
        )
    })?;
    module.name = names.take().into_owned();
    Ok(module)
}
