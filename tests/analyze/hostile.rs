//! Any file content causes at most a remark.

use ecaxis_master::session::Options;
use ecaxis_tools::analyze::{self, Context};
use proptest::prelude::*;

use super::{analyzed, captures, of_file, recorded};
use ecaxis_test_support::{assert_well_formed, axes, machine, virtual_time};

/// The first part of a run: configuration and some cycles.
fn sample() -> &'static [u8] {
    static SAMPLE: std::sync::OnceLock<Vec<u8>> = std::sync::OnceLock::new();
    SAMPLE.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let options = Options {
            repeat: Some(1),
            ..virtual_time()
        };
        let path = recorded(folder.path(), machine(&axes(1)), options);
        let mut bytes = std::fs::read(path).expect("the recording");
        bytes.truncate(120_000);
        bytes
    })
}

fn survives(bytes: &[u8]) {
    let report = analyzed(bytes, Context::default());
    assert_well_formed(&analyze::document("x", &report, &[], false).html());
    serde_json::to_string(&report).expect("JSON");
}

#[test]
fn every_capture_may_be_cut_anywhere() {
    for path in captures() {
        let bytes = std::fs::read(&path).expect("readable");
        let whole = of_file(&path);
        // Cuts short captures at every byte, longer captures at about 60 places and near the end.
        let step = if bytes.len() < 2_000 {
            1
        } else {
            bytes.len() / 60
        };
        let ends = (0..bytes.len())
            .step_by(step)
            // Blocks are padded to four bytes, and steps of seven reach all offsets within a block.
            .chain((bytes.len() - 120..bytes.len()).step_by(7));
        for end in ends {
            let report = analyzed(&bytes[..end], Context::default());
            assert!(report.file.ethercat_frames <= whole.file.ethercat_frames);
            assert!(report.devices.len() <= whole.devices.len(), "cut at {end}");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    #[test]
    fn damage_causes_at_most_a_remark(
        cut in 0_usize..120_000,
        flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..60),
        noise in prop::collection::vec(any::<u8>(), 0..300),
        at in any::<prop::sample::Index>(),
    ) {
        let mut bytes = sample().to_vec();
        bytes.truncate(cut.max(100));
        for (place, value) in flips {
            let place = place.index(bytes.len());
            bytes[place] = value;
        }
        let at = at.index(bytes.len());
        bytes.splice(at..at, noise);
        survives(&bytes);
    }

    /// The files are valid, but the frames contain noise.
    #[test]
    fn hostile_frames_cause_at_most_a_remark(seed in prop::collection::vec(any::<(u8, u16, u16, Vec<u8>, u16)>(), 1..40)) {
        let mut file = Vec::new();
        for word in [0xa1b2_3c4d_u32, 0x0004_0002, 0, 0, 65_535, 1] {
            file.extend(word.to_le_bytes());
        }
        for (n, (command, adp, ado, data, wkc)) in seed.iter().enumerate() {
            for way in [0x10_u8, 0x12] {
                let data = &data[..data.len().min(200)];
                let len = data.len() as u16;
                let mut frame = vec![0xff; 6];
                frame.extend([way, 1, 1, 1, 1, 1, 0x88, 0xa4]);
                frame.extend((0x1000 | (len + 12)).to_le_bytes());
                // Prefers registers and mailboxes that the analysis interprets.
                let ado = [0x10, 0x120, 0x130, 0x502, 0x508, 0x600, 0x800, 0x910, 0x92c, 0x1000, 0x1800, *ado];
                frame.extend([command % 16, n as u8]);
                frame.extend((adp % 4).to_le_bytes());
                frame.extend(ado[usize::from(*wkc) % ado.len()].to_le_bytes());
                frame.extend(len.to_le_bytes());
                frame.extend([0, 0]);
                frame.extend(data);
                frame.extend(if way == 0x10 { 0 } else { wkc % 4 }.to_le_bytes());
                let kept = frame.len() as u32;
                for word in [1, n as u32 * 1000, kept, kept] {
                    file.extend(word.to_le_bytes());
                }
                file.extend(frame);
            }
        }
        survives(&file);
    }
}
