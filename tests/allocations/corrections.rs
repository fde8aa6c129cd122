//! Axes whose mechanics are corrected.

use ecaxis_ecat::index::AxisIndex;
use ecaxis_test_support::{axes, machine, virtual_time};

use super::metered;

/// Reversals that take up backlash and a corrected pitch, with jerk limit and without, compared with
/// a second encoder.
#[test]
fn corrections_allocate_nothing() {
    let keys = "absolute = true\ncompensation = { backlash = 0.05, homing_ends = \"negative\", errors = [[-40.0, 0.02], [0.0, 0.0], [40.0, 0.03]] }\n\
        second_encoder = { input = \"a0.0x6064\", counts_per_unit = 2000.0, max_difference = 0.2 }\n";
    for jerk in ["", "jerk = 20000.0, "] {
        let bus = axes(1);
        let (devices, _) = bus.split_once("\n[[step]]").expect("steps");
        let text = devices.replacen("limits = { ", &format!("{keys}limits = {{ {jerk}"), 1);
        assert!(text.contains("compensation"), "{text}");
        let steps = "[[step]]\nenable = true\n[[step]]\nmove = { a0 = 30.0 }\n[[step]]\nmove = { a0 = 29.99 }\n\
            [[step]]\nvelocity = { a0 = -20.0 }\n[[step]]\ndwell = \"500ms\"\n[[step]]\nstop = true\n[[step]]\nline = { a0 = 10.0 }\n";
        let machine = machine(&format!("{text}\n{steps}"));
        let (counted, remains, result) = metered(machine, &virtual_time(), None, 20_000);
        assert!(matches!(result, Some(Ok(()))), "{result:?}");
        let difference = remains.axes[AxisIndex(0)]
            .last_enabled
            .map(|s| s.encoder_difference);
        assert!(matches!(difference, Some(Some(_))), "{difference:?}");
        assert_eq!(counted, 0);
    }
}
