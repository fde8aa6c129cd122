//! `Mailbox`: the protocols, CoE capabilities and InitCmds. InitCmds of other protocols and of
//! vendor-specific sections are not start-up commands and are skipped.

use super::cursor::{Cursor, Element};
use super::text::Names;
use crate::error::{EsiError, EsiProblem};
use ecaxis_ecat::mailbox::soe::{Idn, MAX_DRIVES};

use crate::model::{Coe, Eoe, IdnInitCmd, InitCmd, Mailbox, SlotDependence, Soe};

pub(super) fn read<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Mailbox, EsiError> {
    let mut mailbox = Mailbox {
        data_link_layer: c.attribute_flag(element, "DataLinkLayer")?,
        ..Mailbox::default()
    };
    c.children(element, |c, el| {
        match el.name {
            "CoE" => mailbox.coe = Some(coe(c, el)?),
            "FoE" => mailbox.foe = true,
            "EoE" => mailbox.eoe = Some(eoe(c, el)?),
            "SoE" => mailbox.soe = Some(soe(c, el)?),
            "AoE" => mailbox.aoe = true,
            "VoE" => mailbox.voe = true,
            _ => {}
        }
        Ok(())
    })?;
    Ok(mailbox)
}

fn eoe<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Eoe, EsiError> {
    Ok(Eoe {
        ip: c.attribute_optional_flag(element, "IP")?,
        mac: c.attribute_optional_flag(element, "MAC")?,
        time_stamp: c.attribute_optional_flag(element, "TimeStamp")?,
    })
}

fn coe<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Coe, EsiError> {
    let mut coe = Coe {
        sdo_info: c.attribute_flag(element, "SdoInfo")?,
        pdo_assign: c.attribute_flag(element, "PdoAssign")?,
        pdo_config: c.attribute_flag(element, "PdoConfig")?,
        pdo_upload: c.attribute_flag(element, "PdoUpload")?,
        complete_access: c.attribute_flag(element, "CompleteAccess")?,
        segmented_sdo: c.attribute_flag(element, "SegmentedSdo")?,
        diag_history: c.attribute_flag(element, "DiagHistory")?,
        init_cmds: Vec::new(),
    };
    c.children(element, |c, el| {
        if el.name == "InitCmd" {
            coe.init_cmds.push(init_cmd(c, el)?);
        }
        Ok(())
    })?;
    Ok(coe)
}

fn soe<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Soe, EsiError> {
    let mut soe = Soe {
        channel_count: c.attribute_number(element, "ChannelCount")?,
        follows_bit: c.attribute_flag(element, "DriveFollowsBit3Support")?,
        init_cmds: Vec::new(),
    };
    c.children(element, |c, el| {
        if el.name == "InitCmd" {
            let read = idn_init_cmd(c, el).map(|cmd| soe.init_cmds.push(cmd));
            return c.leave_out(el, read);
        }
        Ok(())
    })?;
    Ok(soe)
}

fn idn_init_cmd<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<IdnInitCmd, EsiError> {
    let drive: u8 = c.attribute_number(element, "Chn")?.unwrap_or(0);
    if drive >= MAX_DRIVES {
        return Err(c.error_at(
            element,
            EsiProblem::Number {
                what: "InitCmd Chn",
                text: drive.to_string(),
                min: 0,
                max: i128::from(MAX_DRIVES - 1),
            },
        ));
    }
    let mut cmd = IdnInitCmd {
        position: c.position(element),
        transitions: Vec::new(),
        drive,
        idn: Idn::default(),
        data: Vec::new(),
        comment: String::new(),
    };
    let mut comments = Names::default();
    let mut idn = None;
    c.children(element, |c, el| {
        match el.name {
            "Transition" => cmd.transitions.push(c.text(el)?.to_ascii_uppercase()),
            "IDN" => idn = Some(c.number(el, "InitCmd IDN")?),
            "Data" => cmd.data = c.hex_bytes(el, "InitCmd data")?,
            "Comment" => comments.add(c, el)?,
            _ => {}
        }
        Ok(())
    })?;
    let missing = EsiProblem::Missing {
        what: "InitCmd/IDN",
    };
    cmd.idn = Idn(idn.ok_or_else(|| c.error_at(element, missing))?);
    cmd.comment = comments.take().into_owned();
    Ok(cmd)
}

fn init_cmd<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<InitCmd, EsiError> {
    let mut cmd = InitCmd {
        position: c.position(element),
        transitions: Vec::new(),
        index: 0,
        depends_on: SlotDependence::default(),
        sub: 0,
        complete_access: c.attribute_flag(element, "CompleteAccess")?,
        fixed: c.attribute_flag(element, "Fixed")?,
        overwritten_by_module: c.attribute_flag(element, "OverwrittenByModule")?,
        data: Vec::new(),
        adapts: false,
        comment: String::new(),
    };
    let mut comments = Names::default();
    let mut index = None;
    c.children(element, |c, el| {
        match el.name {
            "Transition" => cmd.transitions.push(c.text(el)?.to_ascii_uppercase()),
            "Index" => {
                cmd.depends_on = c.slot_dependence(el)?;
                index = Some(c.number(el, "InitCmd index")?);
            }
            "SubIndex" => cmd.sub = c.number(el, "InitCmd subindex")?,
            "Data" => {
                cmd.adapts = c.attribute_flag(el, "AdaptAutomatically")?;
                cmd.data = c.hex_bytes(el, "InitCmd data")?;
            }
            "Comment" => comments.add(c, el)?,
            _ => {}
        }
        Ok(())
    })?;
    cmd.index = index.ok_or_else(|| {
        c.error_at(
            element,
            EsiProblem::Missing {
                what: "InitCmd/Index",
            },
        )
    })?;
    cmd.comment = comments.take().into_owned();
    Ok(cmd)
}
