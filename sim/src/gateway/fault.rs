//! Faults of the secondary network.

use super::Gateway;

/// A fault of the CAN network behind a gateway.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum GatewayFault {
    /// The node has no power. It boots again when the power returns.
    NodeSilent(u8),
    /// The node sends no heartbeat.
    HeartbeatLost(u8),
    /// The status word names the node as the node in error.
    NodeError(u8),
    /// The cable at the gateway is unplugged. The nodes stay connected to each other.
    CanOpen,
    /// The CANopen side restarts.
    Reset,
    /// The control word has no effect.
    ControlIgnored,
}

/// The faults that last.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Disturbance {
    pub(super) open: bool,
    pub(super) control_ignored: bool,
    /// The node in error, 0 without one.
    pub(super) error_node: u8,
}

impl Gateway {
    /// Begins or ends a fault.
    pub(crate) fn disturb(&mut self, fault: GatewayFault, begins: bool) {
        match fault {
            GatewayFault::NodeSilent(node) => self.set_node_silent(node, begins),
            GatewayFault::HeartbeatLost(node) => {
                let now = self.now;
                if let Some(node) = self.node_mut(node) {
                    node.mute(begins, now);
                }
            }
            GatewayFault::NodeError(node) => {
                self.disturbance.error_node = if begins { node } else { 0 };
            }
            GatewayFault::CanOpen => self.disturbance.open = begins,
            GatewayFault::Reset if begins => self.restart(true, self.now),
            GatewayFault::Reset => {}
            GatewayFault::ControlIgnored => self.disturbance.control_ignored = begins,
        }
    }

    /// Returns the lowest node in error, or 0.
    pub(super) fn error_node(&self) -> u8 {
        let own = self.master.error_node();
        match (own, self.disturbance.error_node) {
            (0, node) | (node, 0) => node,
            (a, b) => a.min(b),
        }
    }
}
