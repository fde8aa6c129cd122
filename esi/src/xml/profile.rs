//! `Profile` of a device or of a module: number, dictionary, diagnosis texts.

use super::cursor::{Cursor, Element};
use super::text::Names;
use super::{datatype, object, resolve};
use crate::error::EsiError;
use crate::model::{DiagMessage, Object};

#[derive(Default)]
pub(super) struct Profile {
    pub number: Option<u32>,
    pub objects: Vec<Object>,
    pub diag_messages: Vec<DiagMessage>,
}

/// Reads `Profile`. The number is in `Profile` itself or, in newer files, in one `ChannelInfo` per
/// axis. The first axis then applies.
pub(super) fn read<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Profile, EsiError> {
    let mut profile = Profile::default();
    let mut of_channel = None;
    c.children(element, |c, el| {
        match el.name {
            "ProfileNo" => profile.number = profile.number.or(Some(c.number(el, "ProfileNo")?)),
            "ChannelInfo" => c.children(el, |c, el| {
                if el.name == "ProfileNo" {
                    of_channel = of_channel.or(Some(c.number(el, "ProfileNo")?));
                }
                Ok(())
            })?,
            "Dictionary" => dictionary(c, el, &mut profile.objects)?,
            "DiagMessages" => c.children(el, |c, el| {
                if el.name == "DiagMessage" {
                    profile.diag_messages.extend(diag_message(c, el)?);
                }
                Ok(())
            })?,
            "DictionaryFile" => c.warn(
                el,
                "the dictionary is in another file, which is not read".to_owned(),
            ),
            _ => {}
        }
        Ok(())
    })?;
    profile.number = profile.number.or(of_channel);
    Ok(profile)
}

fn dictionary<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    objects: &mut Vec<Object>,
) -> Result<(), EsiError> {
    let mut types = datatype::DataTypes::default();
    let mut raw_objects = Vec::new();
    c.children(element, |c, el| match el.name {
        "DataTypes" => datatype::read(c, el, &mut types),
        "Objects" => object::read(c, el, &mut raw_objects),
        _ => Ok(()),
    })?;
    // Objects may precede the types that they use, so both are joined at the end.
    let mut memory = resolve::ResolveCache::default();
    objects.reserve(raw_objects.len());
    for (position, raw) in &raw_objects {
        let place = (*position, element);
        objects.push(resolve::object(c, place, &types, raw, &mut memory)?);
    }
    Ok(())
}

/// Reads a diagnosis text. A text without a valid number is skipped.
fn diag_message<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
) -> Result<Option<DiagMessage>, EsiError> {
    let mut names = Names::default();
    let mut number = None;
    c.children(element, |c, el| {
        match el.name {
            "TextId" => number = c.optional_number::<u32>(el, "TextId")?,
            "MessageText" => names.add(c, el)?,
            _ => {}
        }
        Ok(())
    })?;
    let text_id = number.and_then(|number| u16::try_from(number).ok());
    if text_id.is_none() {
        c.warn(element, "the message has no TextId of 16 bits".to_owned());
    }
    Ok(text_id.map(|text_id| DiagMessage {
        text_id,
        text: names.take().into_owned(),
    }))
}
