//! Probing: a target, an input, and the drive's probe objects in the process data.

use ecaxis_axis::{Edge, Probe};
use toml::Spanned;

use super::ProgramChecker;
use super::target::{TargetKind, within};
use crate::config::Action;
use crate::config::fields::KeyExt;
use crate::config::problem::Problems;
use crate::config::raw::RawProbe;
use ecaxis_esi::layout::Field;
use ecaxis_esi::{Selection, address};

/// Touch probe function 0x60B8 and status 0x60B9.
const FUNCTION: u16 = 0x60b8;
const STATUS: u16 = 0x60b9;

/// Returns the object with the position of an edge: 0x60BA to 0x60BD.
const fn position_object(probe: Probe, edge: Edge) -> u16 {
    match (probe, edge) {
        (Probe::First, Edge::Positive) => 0x60ba,
        (Probe::First, Edge::Negative) => 0x60bb,
        (Probe::Second, Edge::Positive) => 0x60bc,
        (Probe::Second, Edge::Negative) => 0x60bd,
    }
}

impl ProgramChecker<'_> {
    pub(super) fn probe(
        &self,
        name: &Spanned<String>,
        raw: &RawProbe,
        (speed, ramp): (Option<f64>, Option<f64>),
        p: &mut Problems<'_>,
    ) -> Option<Action> {
        let edge = raw.edge.value().unwrap_or(Edge::Positive);
        let probe = match raw.input.value() {
            Some(2) => Probe::Second,
            _ => Probe::First,
        };
        let (index, axis) = self.axis(name, p)?;
        let (what, value) = match (&raw.to, &raw.by) {
            (Some(to), _) => (TargetKind::Position, to),
            (None, Some(by)) => (TargetKind::Way, by),
            // An invalid number has been reported.
            (None, None) => return None,
        };
        if !self.any_mode(index, |mode| TargetKind::Position.possible(mode, axis)) {
            let (_, hint) = TargetKind::Position.impossible(name.get_ref(), axis);
            let message = format!(
                "`probe` is not possible for `{}` in mode \"{}\"",
                name.get_ref(),
                axis.mode
            );
            p.add_hint(name.span(), message, hint);
            return None;
        }
        let inside = within(value, what, axis, p);
        let (speed, ramp) = (speed?, ramp?);
        if let Some(device) = self.devices[self.axes[index].device].device {
            mapped(&device.selection_of(axis), name, probe, edge, p)?;
        }
        inside.then(|| Action::Probe {
            axis: index,
            probe,
            edge,
            relative: what == TargetKind::Way,
            target: *value.get_ref(),
            speed,
            ramp,
        })
    }
}

/// Reports probe objects missing from the process data or from the drive.
fn mapped(
    selection: &Selection,
    name: &Spanned<String>,
    probe: Probe,
    edge: Edge,
    p: &mut Problems<'_>,
) -> Option<()> {
    let layout = &selection.layout;
    let inputs = [STATUS, position_object(probe, edge)];
    let no_output = layout.rx_field(FUNCTION, 0).is_none();
    let missing: Vec<u16> = inputs
        .into_iter()
        .filter(|index| layout.tx_field(*index, 0).is_none())
        .collect();
    if !no_output && missing.is_empty() {
        return Some(());
    }
    let all = no_output.then_some(FUNCTION).into_iter();
    let all: Vec<u16> = all.chain(missing.iter().copied()).collect();
    // An ESI file without a dictionary does not list objects.
    let dictionary = &selection.dictionary;
    let reported = dictionary.item(0x6041, 0).is_some();
    let has = |index: &u16| !reported || dictionary.item(*index, 0).is_some();
    if let Some(unknown) = all.iter().find(|index| !has(index)) {
        let message = format!(
            "by its ESI file `{}` has no touch probe {} that captures such an edge: there is no 0x{unknown:04X}",
            name.get_ref(),
            probe.number()
        );
        let hint = "take the other `input` or `edge`, or the ESI file of the drive's firmware";
        p.add_hint(name.span(), message, hint);
        return None;
    }
    let objects: Vec<String> = all.iter().map(|index| format!("0x{index:04X}")).collect();
    let message = format!(
        "touch probe {} of `{}` needs {} in the process data",
        probe.number(),
        name.get_ref(),
        objects.join(", ")
    );
    let mut lists = Vec::new();
    if no_output {
        lists.push(format!("`pdo.rx = {}`", with(&layout.rx, &[FUNCTION])));
    }
    if !missing.is_empty() {
        lists.push(format!("`pdo.tx = {}`", with(&layout.tx, &missing)));
    }
    let hint = format!("write {} in its [[device]]", lists.join(" and "));
    p.add_hint(name.span(), message, hint);
    None
}

/// Returns the present entries and the missing ones.
fn with(fields: &[Field], more: &[u16]) -> String {
    let there = fields.iter().filter(|field| field.index != 0);
    let there = there.map(|field| match field.sub {
        0 => format!("\"0x{:04X}\"", field.index),
        sub => format!("\"{}\"", address(field.index, sub)),
    });
    let more = more.iter().map(|index| format!("\"0x{index:04X}\""));
    format!("[{}]", there.chain(more).collect::<Vec<_>>().join(", "))
}
