//! Steps that change how an axis handles targets: homing, modes of operation.

use ecaxis_axis::Mode;
use ecaxis_ecat::index::AxisIndex;
use ecaxis_esi as esi;
use toml::Spanned;

use super::ProgramChecker;
use crate::config::Action;
use crate::config::problem::{Problems, Span, list};
use crate::config::raw::RawAxes;

impl ProgramChecker<'_> {
    pub(super) fn home(&self, names: RawAxes, at: &Span, p: &mut Problems<'_>) -> Option<Action> {
        let homes = |index: &AxisIndex| {
            let axis = self.axes[*index].setup;
            axis.is_some_and(|axis| axis.homing.is_some())
        };
        let Some(named) = &names else {
            let all = self.axes(None, p)?;
            let axes: Vec<_> = all.into_iter().filter(homes).collect();
            if axes.is_empty() {
                // An invalid axis has been reported, and may have a homing.
                if self.axes.iter().any(|axis| axis.setup.is_none()) {
                    return None;
                }
                let hint = "add `homing = { method = 37 }` to a [device.axis]";
                p.add_hint(at.clone(), "no axis says how it finds home", hint);
                return None;
            }
            return Some(Action::Home { axes });
        };
        let mut ok = true;
        for name in named {
            if let Some(index) = self.axis_named(name)
                && self.axes[index].setup.is_some()
                && !homes(&index)
            {
                let message = format!("`{}` does not say how it finds home", name.get_ref());
                let hint = "add `homing = { method = 37 }` to its [device.axis]";
                p.add_hint(name.span(), message, hint);
                ok = false;
            }
        }
        let axes = self.axes(names, p)?;
        ok.then_some(Action::Home { axes })
    }

    pub(super) fn mode(
        &mut self,
        name: &Spanned<String>,
        mode: &Spanned<String>,
        p: &mut Problems<'_>,
    ) -> Option<(AxisIndex, Mode)> {
        let (index, axis) = self.axis(name, p)?;
        let offered: Vec<esi::Mode> = esi::Mode::ALL
            .into_iter()
            .filter(|m| *m != esi::Mode::Hm)
            .filter(|m| axis.config.modes.contains(Mode::from_code(m.code())))
            .collect();
        let wanted = offered.iter().find(|m| m.name() == mode.get_ref());
        let Some(wanted) = wanted else {
            let message = format!(
                "`{}` cannot switch to \"{}\"",
                name.get_ref(),
                mode.get_ref()
            );
            let names = offered.iter().map(|m| m.name());
            let hint = format!(
                "it can: {}; for more, map 0x6060, 0x6061 and the mode's target with `pdo.rx` and `pdo.tx`",
                list(names)
            );
            p.add_hint(mode.span(), message, hint);
            return None;
        };
        let wanted = Mode::from_code(wanted.code());
        if !self.switched.contains(&(index, wanted)) {
            self.switched.push((index, wanted));
        }
        Some((index, wanted))
    }
}
