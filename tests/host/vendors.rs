//! A segment of many vendors, from `scan --write` to a move. Only limits are edited.

use std::fmt::Write as _;
use std::process::Stdio;

use ecaxis_tools::bench::veth::VethPair;

use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::host::over_a_pair;
use ecaxis_test_support::program::{ProgramOutput, ecaxis};
use ecaxis_test_support::{fixture, tolerant};

/// A device: its ESI file among the fixtures, which device of the file it is, and whether it is a
/// drive.
type Fitted = (&'static str, &'static str, bool);

const SEGMENT: [Fitted; 16] = [
    (
        "maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml",
        "",
        true,
    ),
    (
        "elmo/Elmo_ECAT_00010420_V11.xml",
        "product = 0x30924\nrevision = 0x10420",
        true,
    ),
    ("synapticon/SOMANET_CiA_402_v4.xml", "", true),
    ("stepperonline/STEPPERONLINE_A6_Servo_V0.02.xml", "", true),
    ("inovance/SV660_EOE_1Axis_V9.12.xml", "", true),
    ("hpmicro/ECAT_CIA402.xml", "", true),
    (
        "maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml",
        "",
        true,
    ),
    ("kubabuda/STMBL_ECAT.xml", "", true),
    ("hilscher/Hilscher_NETX90_RE_ECS_V5.2.0.xml", "", false),
    ("metalmusings/MetalMusings_EaserCAT_3000.xml", "", false),
    (
        "nonnoise/ArtifactNoise_EtherCATBord_GPO16.xml",
        "product = 0x21",
        false,
    ),
    ("soes/rtl_xmc4_dynpdo_slave.xml", "", false),
    ("beckhoff/Beckhoff EK11xx.xml", "type = \"EK1100\"", false),
    ("beckhoff/Beckhoff EL1xxx.xml", "type = \"EL1008\"", false),
    ("beckhoff/Beckhoff EL1xxx.xml", "type = \"EL1018\"", false),
    ("beckhoff/Beckhoff EL1xxx.xml", "type = \"EL1004\"", false),
];
const VENDORS: usize = 9;

fn serve(bench: &Bench, pair: &VethPair) -> ProgramOutput {
    let mut command = bench.command(ecaxis());
    command.args(["sim", "segment.toml", "--nic", &pair.a]);
    let mut served = ProgramOutput::start(command.stdout(Stdio::null()));
    served.says("answer");
    served
}

#[test]
fn sixteen_devices_of_nine_vendors_move_after_a_scan() {
    let Some(files) = fixture("esi") else {
        return;
    };
    let folders = SEGMENT.iter().filter_map(|fitted| fitted.0.split_once('/'));
    let mut vendors: Vec<&str> = folders.map(|(vendor, _)| vendor).collect();
    vendors.sort_unstable();
    vendors.dedup();
    assert!(vendors.len() >= VENDORS, "{vendors:?}");
    let mut segment = String::from("[bus]\nnic = \"sim\"\ncycle = \"4ms\"\n");
    for (position, (file, kind, is_drive)) in SEGMENT.iter().enumerate() {
        let path = files.join(file);
        let _ = write!(
            segment,
            "[[device]]\nname = \"d{position}\"\nesi = \"{}\"\nposition = {position}\n",
            path.display()
        );
        let _ = writeln!(segment, "{kind}");
        if *is_drive {
            segment += "mode = \"csp\"\n[device.axis]\nencoder = 2000\nlimits = { velocity = 1.0, acceleration = 10.0 }\n";
        }
    }
    over_a_pair(|pair| {
        let bench = Bench::new();
        bench.write("segment.toml", &segment);
        for (file, ..) in SEGMENT {
            let (_, name) = file.split_once('/').expect("a folder");
            let to = bench.path().join("vendors");
            std::fs::create_dir_all(&to).expect("a folder");
            std::fs::copy(files.join(file), to.join(name)).expect("an ESI file");
        }
        let _served = serve(&bench, &pair);
        let scan = ["scan", &pair.b, "--esi", "vendors", "--write"];
        bench.well(&[&scan[..], &["machine.toml"]].concat());
        // A computer that runs tests cannot keep a cycle of 1 ms.
        let text = tolerant(&bench.read("machine.toml"));
        bench.write("machine.toml", &text.replace("\"1ms\"", "\"4ms\""));
        let ran = bench.ecaxis(&["run", "machine.toml", "--enable", "--json"]);
        let json: serde_json::Value = serde_json::from_str(&ran.out).expect("JSON");
        assert_eq!(ran.code, 0, "{}\n{json:#}", ran.err);
        assert_eq!(json["summary"]["program_runs"], 1, "{json:#}");
        let axes = json["summary"]["axes"].as_array().expect("the axes");
        assert_eq!(axes.len(), SEGMENT.iter().filter(|fitted| fitted.2).count());
    });
}
