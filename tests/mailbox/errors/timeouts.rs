//! Devices that do not answer, answer late, or send other messages without end.

use std::cell::Cell;

use super::*;

#[test]
fn a_mute_device_times_out() {
    let (error, log) = upload_error(0x6041, &[Mischief::Mute]);
    let after = Duration::from_millis(500);
    let timeout = sdo_error(
        0x6041,
        CoeCause::Timeout {
            phase: Phase::Answer,
            after,
            set_aside: 0,
        },
    );
    assert_eq!(error, timeout);
    assert_eq!(log.len(), 1, "a request that came back is not sent again");
}

#[test]
fn a_mailbox_that_stays_full_times_out() {
    let server = server(&[Mischief::Deaf]);
    let mut client = client();
    // The first request fits but is not answered; the second finds the mailbox full.
    let first = block_on(client.upload(&server, 0x6041, 0, false)).unwrap_err();
    assert!(
        matches!(
            first.cause,
            CoeCause::Timeout {
                phase: Phase::Answer,
                ..
            }
        ),
        "{first}"
    );
    let before = server.now();
    let second = block_on(client.upload(&server, 0x6041, 0, false)).unwrap_err();
    assert!(
        matches!(
            second.cause,
            CoeCause::Timeout {
                phase: Phase::Request,
                ..
            }
        ),
        "{second}"
    );
    assert!(
        second
            .to_string()
            .contains("the mailbox was not free within 100ms"),
        "{second}"
    );
    assert!(server.now() - before < 150_000_000);
}

fn gone(index: u16) -> SdoError {
    sdo_error(index, CoeCause::Gone)
}

#[test]
fn missing_device_fails_without_timeout() {
    let server = server(&[Mischief::Off]);
    let error = block_on(client().upload(&server, 0x6041, 0, false)).unwrap_err();
    assert_eq!(error, gone(0x6041));
    assert_eq!(
        block_on(client().drain(&server)),
        Err(SdoError {
            station: STATION,
            asked: Subject::Emptying,
            cause: CoeCause::Gone
        })
    );
    assert!(server.now() < 10_000_000, "{}", server.now());
}

#[test]
fn device_lost_in_mid_transfer_fails_without_timeout() {
    let server = server(&[Mischief::Mute]);
    let mut client = client();
    block_on(client.drain(&server)).unwrap();
    server.commit(Mischief::Off);
    let error = block_on(client.download(&server, 0x2000, 0, false, LONG)).unwrap_err();
    assert_eq!(error, gone(0x2000));
}

#[test]
fn timeout_error_counts_unrelated_answers() {
    let other = [
        10, 0, 0, 0, 0, 0x13, 0, 0x30, 0x4b, 0x64, 0x60, 0, 1, 0, 0, 0,
    ];
    let (error, _) = upload_error(0x6041, &[Mischief::Replace(1, other.to_vec())]);
    assert!(
        matches!(
            error.cause,
            CoeCause::Timeout {
                phase: Phase::Answer,
                set_aside: 1,
                ..
            }
        ),
        "{error}"
    );
    assert!(
        error
            .to_string()
            .ends_with("(1 answer to something else was set aside)"),
        "{error}"
    );
}

/// A late answer to a timed-out request must not be taken for the answer to the same request made
/// later.
#[test]
fn a_late_answer_is_not_taken_for_the_next_one() {
    let server = server(&[Mischief::Deaf]);
    let mut client = client();
    block_on(async {
        client.upload(&server, 0x6041, 0, false).await.unwrap_err();
        server.forgive();
        server.delay(Duration::from_millis(5)).await;
        server.set(0x6041, 0, &[0x50, 0x02]);
        assert_eq!(
            client.upload(&server, 0x6041, 0, false).await.unwrap(),
            [0x50, 0x02]
        );
    });
    assert_eq!(client.set_aside(), 1);
}

/// Time passes only while the client waits, and there is always another message.
#[test]
fn endless_messages_end_in_bounded_time() {
    struct Flood(Cell<u64>);
    impl MailboxTransport for Flood {
        async fn read(&self, _: u16, register: u16, buf: &mut [u8]) -> Result<u16, DatagramError> {
            if register < 0x1000 {
                buf.fill(u8::from(register == 0x080d) << 3);
            } else {
                let sdo_info = [10, 0, 0, 0, 0, 0x13, 0, 0x80, 2, 0, 0, 0, 0, 0, 0, 0];
                buf[..16].copy_from_slice(&sdo_info);
            }
            Ok(1)
        }
        async fn write(&self, _: u16, _: u16, _: &[u8]) -> Result<u16, DatagramError> {
            Ok(1)
        }
        async fn delay(&self, duration: Duration) {
            self.0
                .set(self.0.get() + u64::try_from(duration.as_nanos()).unwrap());
        }
        fn now(&self) -> u64 {
            self.0.get()
        }
    }
    let wire = Flood(Cell::new(0));
    let error = block_on(client().upload(&wire, 0x6041, 0, false)).unwrap_err();
    assert!(
        matches!(
            error.cause,
            CoeCause::Timeout {
                phase: Phase::Answer,
                ..
            }
        ),
        "{error}"
    );
    assert_eq!(block_on(client().drain(&wire)), Ok(64));
}

#[test]
fn unrepeated_lost_answer_times_out() {
    let (error, _) = upload_error(0x6041, &[Mischief::LoseAnswer(1), Mischief::NoRepeat]);
    assert!(
        matches!(
            error.cause,
            CoeCause::Timeout {
                phase: Phase::Repeat,
                ..
            }
        ),
        "{error}"
    );
    let again: Vec<_> = (1..=9).map(Mischief::LoseAnswer).collect();
    let (error, _) = upload_error(0x6041, &again);
    assert!(
        matches!(
            error.cause,
            CoeCause::Timeout {
                phase: Phase::Repeat,
                ..
            }
        ),
        "{error}"
    );
}

#[test]
fn endless_emergencies_do_not_block_the_client() {
    let server = server(&[Mischief::Mute]);
    for _ in 0..10_000 {
        server.say(&emergency(0x8130));
    }
    let mut client = client();
    let error = block_on(client.upload(&server, 0x6041, 0, false)).unwrap_err();
    assert!(
        matches!(
            error.cause,
            CoeCause::Timeout {
                phase: Phase::Answer,
                ..
            }
        ),
        "{error}"
    );
    assert!(server.now() < 700_000_000, "{}", server.now());
}

#[test]
fn a_silent_bus_is_reported_as_such() {
    let error = block_on(client().upload(&Silent, 0x6041, 0, false)).unwrap_err();
    assert!(
        matches!(
            error.cause,
            CoeCause::Wire(DatagramError::Timeout {
                station: STATION,
                ..
            })
        ),
        "{error}"
    );
}
