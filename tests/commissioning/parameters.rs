//! Parameters and EEPROMs of simulated devices: through the library in virtual time, and through
//! `ecaxis sdo` and `ecaxis eeprom`.

mod cli;
mod restore;
use std::thread;

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_esi::Dictionary;
use ecaxis_master::acyclic::eeprom::{Eeprom, EepromAccess};
use ecaxis_master::acyclic::image::{with_alias, write};
use ecaxis_master::acyclic::parameters::compare::compare;
use ecaxis_master::acyclic::parameters::dictionary;
use ecaxis_master::acyclic::parameters::restore::restore;
use ecaxis_master::acyclic::parameters::upload::{UploadResult, collect};
use ecaxis_master::acyclic::{AlState, al};
use ecaxis_master::acyclic::{DatagramClient, Registers, device, mailbox};
use ecaxis_master::bringup::bring_up;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::Clock;
use ecaxis_master::config::{self, Locator, Machine};
use ecaxis_master::link::scan_answers::ScanAnswers;
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::mailbox::worker::EmergencySink;
use ecaxis_master::mailbox::{CoeClient, Emergencies, FoeClient, MailboxTransport, ObjectList};
use ecaxis_master::parameters::class::CopyRule;
use ecaxis_master::parameters::dump::Dump;
use ecaxis_master::parameters::{DataType, Kind, items};
use ecaxis_master::report::{Cause, Error};
use ecaxis_master::rt::image::plan;
use ecaxis_master::session::run_on_link;
use ecaxis_master::session::simulated_bus;
use ecaxis_sim::FirmwareHeader;
use ecaxis_test_support::{fixture, machine, root};

/// Ignores emergencies.
#[derive(Debug)]
struct Deaf;

impl EmergencySink for Deaf {
    fn listen(&self, _: &str, _: &Emergencies) {}
}

/// The stack size; futures in these tests hold whole frames by value.
const STACK: usize = 16 << 20;

type Work<T> = Box<dyn FnOnce(&mut SimLink) -> T + Send>;

/// Runs operations on a machine's simulated bus in virtual time, with a power cycle between them.
fn on<T: Send + 'static>(machine: Machine, works: Vec<Work<T>>) -> Vec<T> {
    let there = thread::Builder::new().stack_size(STACK).spawn(move || {
        Clock::Virtual.enter();
        let segment = simulated_bus(&machine, 1, None, None).expect("a bus");
        let mut link = SimLink::new(segment);
        let count = machine.devices.len();
        let mut done = Vec::new();
        for work in works {
            done.push(work(&mut link));
            for position in 0..count {
                link.segment_mut().power(position, false);
                link.segment_mut().power(position, true);
            }
        }
        done
    });
    there.expect("a thread").join().expect("no panic")
}

fn carried<T>(link: &mut SimLink, work: impl AsyncFnOnce(DatagramClient) -> T) -> T {
    run_on_link(link, Clock::Virtual, &CancelToken::default(), work).expect("carried")
}

/// Runs an operation on one device's mailbox.
async fn with_device<T>(
    wire: &DatagramClient,
    position: u16,
    work: impl AsyncFnOnce(&mut CoeClient) -> T,
) -> T {
    let at = Locator::Position(position);
    let (_, at) = device::locate(wire, at, None).await.expect("located");
    let sii = device::read_sii(wire, &at, EepromAccess::Force).await;
    let sii = sii.expect("an image");
    let done: Result<T, Error> = device::with_mailbox(wire, &at, &sii, "a test", async |lent| {
        Ok(work(&mut lent.coe).await)
    })
    .await;
    done.expect("a mailbox")
}

/// Transfers 64 KiB in segments in both directions.
async fn large_object_there_and_back(coe: &mut CoeClient, wire: &DatagramClient) {
    let data: Vec<u8> = (0..65_536_u32).map(|n| (n * 7 + n / 251) as u8).collect();
    let written = coe.download(wire, 0x2100, 0, false, &data).await;
    written.expect("written");
    let back = coe.upload(wire, 0x2100, 0, false).await.expect("read");
    assert!(back == data, "{} bytes", back.len());
}

/// Returns a device with mailboxes of 48 bytes and more than 440 objects, including one of 64 KiB
/// and a record of 60 entries.
fn large() -> (tempfile::TempDir, Machine) {
    large_with(|esi| esi)
}

/// Same as `large`, with a changed ESI.
fn large_with(change: impl FnOnce(String) -> String) -> (tempfile::TempDir, Machine) {
    let folder = tempfile::tempdir().expect("a folder");
    let esi = root().join("tests/judges/esi/mailbox.xml");
    let text = std::fs::read_to_string(esi).expect("the judges' ESI");
    let sub = |n: u32| {
        format!(
            "<SubItem><SubIdx>{n}</SubIdx><Name>Entry {n}</Name><Type>UDINT</Type><BitSize>32</BitSize><BitOffs>{}</BitOffs><Flags><Access>rw</Access></Flags></SubItem>",
            16 + 32 * (n - 1)
        )
    };
    let types = format!(
        "<DataType><Name>ARRAY [0..65535] OF BYTE</Name><BaseType>BYTE</BaseType><BitSize>524288</BitSize><ArrayInfo><LBound>0</LBound><Elements>65536</Elements></ArrayInfo></DataType>\
        <DataType><Name>DT3000</Name><BitSize>{}</BitSize><SubItem><SubIdx>0</SubIdx><Name>SubIndex 000</Name><Type>USINT</Type><BitSize>8</BitSize><BitOffs>0</BitOffs><Flags><Access>ro</Access></Flags></SubItem>{}</DataType></DataTypes>",
        16 + 60 * 32,
        (1..=60).map(sub).collect::<String>(),
    );
    let values: String = (1..=60)
        .map(|n| format!("<SubItem><Name>Entry {n}</Name><Info><DefaultValue>{}</DefaultValue></Info></SubItem>", n * 1000))
        .collect();
    let kinds = [
        ("UINT", 16),
        ("DINT", 32),
        ("REAL", 32),
        ("USINT", 8),
        ("LREAL", 64),
    ];
    let many: String = (0..420)
        .zip(kinds.iter().cycle())
        .map(|(n, (name, bits))| {
            format!(
                "<Object><Index>#x{:04X}</Index><Name>Parameter number {n}</Name><Type>{name}</Type><BitSize>{bits}</BitSize><Flags><Access>rw</Access></Flags></Object>",
                0x4000 + n
            )
        })
        .collect();
    let objects = format!(
        "<Object><Index>#x2100</Index><Name>A large object</Name><Type>ARRAY [0..65535] OF BYTE</Type><BitSize>524288</BitSize><Flags><Access>rw</Access></Flags></Object>\
        <Object><Index>#x3000</Index><Name>A long record</Name><Type>DT3000</Type><BitSize>{}</BitSize><Info><SubItem><Name>SubIndex 000</Name><Info><DefaultValue>60</DefaultValue></Info></SubItem>{values}</Info></Object>{many}</Objects>",
        16 + 60 * 32,
    );
    let text = text
        .replacen("</DataTypes>", &types, 1)
        .replacen("</Objects>", &objects, 1);
    std::fs::write(folder.path().join("large.xml"), change(text)).expect("written");
    let file = folder.path().join("machine.toml");
    std::fs::write(
        &file,
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"large\"\nesi = \"large.xml\"\nposition = 0\n",
    )
    .expect("written");
    let machine = config::load(&file).unwrap_or_else(|error| panic!("{error}"));
    (folder, machine)
}

#[test]
fn a_small_mailbox_transfers_large_objects() {
    let (_folder, machine) = large();
    let described = machine.devices[DeviceIndex(0)].selection.dictionary.clone();
    let work = Box::new(move |link: &mut SimLink| {
        carried(link, async |wire| {
            with_device(&wire, 0, async |coe| {
                assert_eq!((coe.layout().out_len, coe.layout().in_len), (48, 48));
                large_object_there_and_back(coe, &wire).await;

                // Reads the record with complete access and by subindex.
                let whole = coe.upload(&wire, 0x3000, 0, true).await.expect("read");
                let (count, entries) = whole.split_at(2);
                assert_eq!((count, entries.len()), (&[60, 0][..], 240));
                let (entries, _) = entries.as_chunks::<4>();
                for (n, entry) in (1..).zip(entries) {
                    let one = coe.upload(&wire, 0x3000, n, false).await.expect("read");
                    assert_eq!(one, entry);
                    assert_eq!(u32::from_le_bytes(*entry), u32::from(n) * 1000);
                }

                // Reads the object list and the description of every object.
                let list = coe
                    .object_list(&wire, ObjectList::All)
                    .await
                    .expect("a list");
                assert!(list.len() >= 440, "{}", list.len());
                let at = device::locate(&wire, Locator::Position(0), None)
                    .await
                    .expect("there")
                    .1;
                let mut reported = (0, 0);
                let mut progress = |done, all| reported = (done, all);
                let own = dictionary::dictionary(coe, &wire, &at, &mut progress).await;
                let own = own.expect("a dictionary");
                assert_eq!(reported, (list.len() - 1, list.len()));
                assert_eq!(own.failed, []);
                same(&described, &own.dictionary);
            })
            .await;
        });
    });
    on(machine, vec![work]);
}

/// The maximum mailbox size: one datagram of a full frame.
#[test]
fn frame_sized_mailboxes_transfer_everything() {
    let (_folder, machine) = large_with(|esi| {
        let long = esi.replace("DefaultSize=\"48\"", "DefaultSize=\"1486\"");
        let boot = "<BootStrap>0010000100160001</BootStrap>";
        assert!(long.contains(boot));
        long.replace(boot, "<BootStrap>0010ce050016ce05</BootStrap>")
    });
    let identity = machine.devices[DeviceIndex(0)].device.identity;
    let header = FirmwareHeader {
        vendor: identity.vendor,
        product: identity.product,
        revision: 2,
        version: *b"2.00",
    };
    let program: Vec<u8> = (0..10_000_u32).map(|n| (n * 13 + n / 251) as u8).collect();
    let file = header.file(&program);
    let sent = file.clone();
    let work = Box::new(move |link: &mut SimLink| {
        carried(link, async |wire| {
            with_device(&wire, 0, async |coe| {
                assert_eq!((coe.layout().out_len, coe.layout().in_len), (1486, 1486));
                let vendor = coe.upload(&wire, 0x1018, 1, false).await.expect("read");
                assert_eq!(vendor, identity.vendor.to_le_bytes());
                // In one message, and in segments.
                assert_eq!(
                    coe.upload(&wire, 0x2000, 0, false)
                        .await
                        .expect("read")
                        .len(),
                    500
                );
                large_object_there_and_back(coe, &wire).await;
            })
            .await;

            let at = device::locate(&wire, Locator::Position(0), None).await;
            let (_, at) = at.expect("located");
            let sii = device::read_sii(&wire, &at, EepromAccess::Force).await;
            let sii = sii.expect("an image");
            let registers = Registers {
                wire: &wire,
                device: &at,
                step: "a test",
            };
            let layout = mailbox::configure(&registers, &sii, sii.bootstrap).await;
            let layout = layout.expect("configured");
            assert_eq!((layout.out_len, layout.in_len), (1486, 1486));
            let devices = std::slice::from_ref(&at);
            let patient = mailbox::PRE_OP_TIMEOUT;
            al::change_state(&wire, devices, AlState::Bootstrap, patient)
                .await
                .expect("Bootstrap");
            let mut foe = FoeClient::new(layout);
            foe.write(&wire, "new.bin", 0, &sent, &mut |_| {})
                .await
                .expect("written");
            let back = foe.read(&wire, "new.bin", 0, 1 << 20, &mut |_| {}).await;
            assert!(back.expect("read") == sent);
        });
        let device = link.segment().device(0).expect("a device");
        assert_eq!(device.firmware(), Some(&file[..]));
    });
    on(machine, vec![work]);
}

/// Checks that the device's own description equals that of the ESI.
fn same(described: &Dictionary, own: &Dictionary) {
    for (object, item) in items(described) {
        let at = format!("{:#06x}:{:02}", object.index, item.sub);
        let reported = own
            .object(object.index)
            .unwrap_or_else(|| panic!("{at} is missing"));
        assert_eq!(reported.name, object.name, "{at}");
        let found = own.item(object.index, item.sub);
        let found = found.unwrap_or_else(|| panic!("{at} is missing"));
        if !item.name.is_empty() {
            assert_eq!(found.name, item.name, "{at}");
        }
        assert_eq!(found.access, item.access, "{at}");
        let types =
            [item, found].map(|i| DataType::named(&i.type_name, i.bit_len).expect("a type"));
        let [expected, reported] = types;
        assert_eq!(reported.kind, expected.kind, "{at}");
        if expected.bits <= 0xffff {
            assert_eq!(reported.bits, expected.bits, "{at}");
        }
    }
}

/// Returns two drives of one type.
fn twins(esi: &str) -> Machine {
    let drive = |name: &str, position: u32| {
        format!(
            "[[device]]\nname = \"{name}\"\nesi = \"{esi}\"\ntype = \"EPOS4\"\nposition = {position}\nmode = \"csp\"\n[device.axis]\nunit = \"turn\"\nencoder = 2000\nlimits = {{ position = [-1000.0, 1000.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }}\n"
        )
    };
    machine(&format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n{}{}",
        drive("x", 0),
        drive("y", 1)
    ))
}

async fn everything(wire: &DatagramClient, position: u16, dictionary: &Dictionary) -> UploadResult {
    let at = device::locate(wire, Locator::Position(position), None)
        .await
        .expect("there")
        .1;
    with_device(wire, position, async |coe| {
        let all = collect(coe, wire, &at, dictionary, &mut |_, _| {}).await;
        all.expect("collected")
    })
    .await
}

/// Changes every changeable setting, saves it in a file, and restores it to the other drive.
fn from_one_to_the_other(machine: Machine) -> (usize, usize) {
    let dictionary = machine.devices[DeviceIndex(0)].selection.dictionary.clone();
    let rule = CopyRule::to_other_unit(0xfb);
    let work = Box::new(move |link: &mut SimLink| {
        carried(link, async |wire| {
            let before = everything(&wire, 0, &dictionary).await;
            assert_eq!(before.refused, []);
            // Changes every setting that accepts another value; PDO lists become shorter.
            let mut changed = 0;
            with_device(&wire, 0, async |coe| {
                for list in [0x1c12, 0x1c13] {
                    let _ = coe.download(&wire, list, 0, false, &[0]).await;
                }
                for parameter in before.parameters.iter().filter(|p| rule.copies(p)) {
                    let (index, sub) = (parameter.at.index, parameter.at.sub);
                    let mut value = parameter.value.clone();
                    if let (Kind::Unsigned | Kind::Signed, Some(first)) =
                        (parameter.data_type.kind, value.first_mut())
                    {
                        *first = if index < 0x1c00 && sub == 0 && *first > 0 {
                            *first - 1
                        } else {
                            *first ^ 1
                        };
                        let list = (0x1600..0x1d00).contains(&index) && sub > 0;
                        if !list && coe.download(&wire, index, sub, false, &value).await.is_ok() {
                            changed += 1;
                        }
                    }
                }
            })
            .await;

            let left = everything(&wire, 0, &dictionary).await;
            let right = everything(&wire, 1, &dictionary).await;
            let differ = compare(&left.parameters, &right.parameters, rule, false);
            assert!(changed > 0 && !differ.is_empty());
            let dump = Dump {
                parameters: left.parameters,
                ..Dump::default()
            };
            let dump = Dump::parse(&dump.to_toml()).expect("a file");

            let at = device::locate(&wire, Locator::Position(1), None)
                .await
                .expect("there")
                .1;
            let restored = with_device(&wire, 1, async |coe| {
                let file = (dump.parameters.as_slice(), rule);
                let done = restore(coe, &wire, &at, Some(&dictionary), file, &mut |_, _| {}).await;
                done.expect("restored")
            })
            .await;
            assert!(restored.complete(), "{restored:?}");
            // Elements beyond the count of a shorter list are not written.
            let meant = differ.iter().filter(|difference| difference.left.is_some());
            assert_eq!(restored.written.len(), meant.count(), "{restored:?}");

            let right = everything(&wire, 1, &dictionary).await;
            let differ_now = compare(&dump.parameters, &right.parameters, rule, false);
            assert_eq!(differ_now, []);
            // A second restore has nothing to write.
            let again = with_device(&wire, 1, async |coe| {
                let file = (dump.parameters.as_slice(), rule);
                let done = restore(coe, &wire, &at, Some(&dictionary), file, &mut |_, _| {}).await;
                done.expect("restored")
            })
            .await;
            assert_eq!(
                (again.written.len(), again.complete()),
                (0, true),
                "{again:?}"
            );
            (differ.len(), restored.written.len())
        })
    });
    on(machine, vec![work])[0]
}

#[test]
fn the_settings_of_one_drive_are_restored_to_another() {
    let (differed, written) = from_one_to_the_other(twins("esi/EPOS4.xml"));
    assert!(differed >= 15 && written >= 15, "{differed} {written}");
}

#[test]
fn settings_are_restored_with_the_vendor_esi_as_well() {
    let Some(esi) = fixture("esi/maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml") else {
        return;
    };
    let esi = esi.canonicalize().expect("a path");
    let (differed, written) = from_one_to_the_other(twins(esi.to_str().expect("UTF-8")));
    assert!(differed >= 50 && written >= 50, "{differed} {written}");
}

#[test]
fn a_written_alias_applies_after_the_next_power_on() {
    let text = std::fs::read_to_string(root().join("configs/demo.toml")).expect("the demo");
    let demo = machine(&text);
    let by_alias = machine(&text.replacen("position = 0", "alias = 1001", 1));
    let set = Box::new(|link: &mut SimLink| {
        carried(link, async |wire| {
            let at = device::locate(&wire, Locator::Position(0), None)
                .await
                .expect("there")
                .1;
            let eeprom = Eeprom::claim(&wire, &at, "writing", EepromAccess::IfFree)
                .await
                .expect("free");
            let mut image = eeprom.image(&mut |_, _| {}).await.expect("an image");
            let area = with_alias(*image.first_chunk().expect("an area"), 1001);
            image[..area.len()].copy_from_slice(&area);
            let words = write(&eeprom, &image, &mut |_, _| {})
                .await
                .expect("written");
            // The alias and the checksum.
            assert_eq!(words, 2);
            // The new alias does not apply before the next power-on.
            let found = device::locate(&wire, Locator::Alias(1001), None).await;
            assert!(
                matches!(&found, Err(error) if matches!(*error.cause, Cause::NotFound { .. })),
                "{found:?}"
            );
        });
    });
    let find = Box::new(move |link: &mut SimLink| {
        carried(link, async |wire| {
            let (found, _) = device::locate(&wire, Locator::Alias(1001), None)
                .await
                .expect("found");
            assert_eq!(found.position, 0);
            let image = plan(&by_alias.rt_config().devices).expect("a plan");
            let answers = ScanAnswers::default();
            let bus = bring_up(wire, &answers, &by_alias, image, &|_| {}, &Deaf).await;
            let bus = bus.unwrap_or_else(|error| panic!("{error}"));
            let x = &bus.devices[DeviceIndex(0)].at;
            assert_eq!((x.name.as_str(), x.position), ("x", 0));
        });
    });
    on(demo, vec![set, find]);
}

#[test]
fn a_device_in_init_returns_to_init_with_its_eeprom_assignment() {
    let work = Box::new(|link: &mut SimLink| {
        carried(link, async |wire| {
            // Other MainDevices leave the device in this state: Init, with its EEPROM assigned to
            // the PDI.
            let at = device::locate(&wire, Locator::Position(0), None).await;
            let station = at.expect("there").1.station;
            wire.write(station, 0x0500, &[1]).await.expect("written");
            let state = async |wire: &DatagramClient| {
                let at = device::locate(wire, Locator::Position(0), None).await;
                at.expect("there").0.state
            };
            let status = async |coe: &mut CoeClient| {
                coe.upload(&wire, 0x6041, 0, false)
                    .await
                    .expect("read")
                    .len()
            };
            assert_eq!(state(&wire).await, AlState::Init);
            assert_eq!(with_device(&wire, 0, status).await, 2);
            assert_eq!(state(&wire).await, AlState::Init);
            let mut lent = [0];
            wire.read(station, 0x0500, &mut lent).await.expect("read");
            assert_eq!(lent, [1]);
        });
    });
    on(twins("esi/EPOS4.xml"), vec![work]);
}
