//! The loop that listens to the operator.

use std::sync::Arc;

use ecaxis_axis::Command;

use super::desk::{Commands, Desk, Doing, Scene};
use super::{News, Operator, Presence, View};
use crate::clock;
use crate::rt::groups::GroupStatus;
use crate::rt::handover::Order;
use crate::session::RunError;
use crate::supervise::Supervisor;
use crate::supervise::faults::MODES_OF_OPERATION_DISPLAY;

/// Requests taken at one turn, besides stops.
const MOST_REQUESTS: usize = 64;

impl Supervisor {
    /// Until the operator leaves. Axes are enabled when they are asked to be.
    pub(in crate::supervise) async fn attend(
        &mut self,
        operator: &mut dyn Operator,
    ) -> Result<(), RunError> {
        let patience = self.machine.bus.enable_timeout_ns + self.longest_stop();
        let all: Vec<usize> = (0..self.axes.len()).collect();
        let patience = patience + self.longest_release(&all);
        let mut desk = Desk::new(self.axes.len(), patience);
        let (machine, axes) = (Arc::clone(&self.machine), self.axes.clone());
        // Enabled axes whose mode is still to be read, because it is not in their process data.
        let mut enabled: Vec<usize> = Vec::new();
        let hidden = |axis: usize| {
            let device = axes.get(axis).and_then(|&d| machine.devices.get(d));
            let layout = device.map(|device| &device.selection.layout);
            layout.is_some_and(|layout| layout.tx_field(MODES_OF_OPERATION_DISPLAY, 0).is_none())
        };
        let just_enabled = |news: &News| match *news {
            News::Done {
                axis,
                what: Doing::Enabling,
            } if hidden(axis) => Some(axis),
            _ => None,
        };
        loop {
            let snapshot = self.glance().await?;
            let mut commands = Commands::new();
            let scene = Scene {
                now: clock::now(),
                machine: &machine,
                axes: &axes,
                snapshot: &snapshot,
            };
            for (axis, reason) in self.refused.drain(..) {
                desk.refused(axis, reason, &scene, &mut commands);
            }
            // Until then the snapshot does not show what was ordered.
            if snapshot.orders_taken >= self.orders_given {
                desk.look(&scene, &mut commands);
            }
            let news: Vec<News> = desk.news.drain(..).collect();
            let turn = operator.turn(&View {
                now: scene.now,
                machine: scene.machine,
                axes: scene.axes,
                snapshot: &snapshot,
                hands: &desk.hands,
                news: &news,
            });
            desk.watch(&scene, turn.presence, &mut commands);
            let there = turn.presence == Presence::Here;
            for (index, request) in turn.requests.into_iter().enumerate() {
                if request.stops() || (there && index < MOST_REQUESTS) {
                    desk.take(request, &scene, &mut commands);
                }
            }
            let stopped = |group: (usize, &GroupStatus)| {
                group.1.stopped.is_some() && !self.is_stopped(group.0)
            };
            let just_stopped = snapshot.groups.iter().enumerate().any(stopped);
            enabled.extend(news.iter().filter_map(just_enabled));
            // Devices answer when they like, and nobody watches a key meanwhile.
            if just_stopped || !enabled.is_empty() {
                desk.brake(&scene, &mut commands);
            }
            let orders = commands.into_iter();
            let orders = orders.map(|(axis, command)| Order::Axis { axis, command });
            let orders: Vec<Order> = orders.collect();
            if !orders.is_empty() {
                self.orders(&orders).await;
            }
            if turn.presence == Presence::Gone {
                // They have been seen, and are not what winding down is to tell of.
                let ill = |axis: &usize| {
                    let status = snapshot.axes.get(*axis);
                    status.is_some_and(|s| s.fault.is_some() || s.trip.is_some())
                };
                self.seen = all.iter().copied().filter(ill).collect();
                return Ok(());
            }
            if desk.moves() {
                continue;
            }
            self.ask_devices(&snapshot).await;
            for axis in enabled.drain(..) {
                let own = self.setup(axis).map(|setup| setup.config.mode);
                let other = own != snapshot.axes.get(axis).map(|status| status.mode);
                if !other && let Err(error) = self.confirm_modes(&[axis]).await {
                    let what = Doing::Enabling;
                    let why = error.to_string();
                    desk.news.push_back(News::Failed { axis, what, why });
                    let command = Command::Disable;
                    self.order(Order::Axis { axis, command }).await;
                }
            }
        }
    }
}
