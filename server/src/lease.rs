//! Who owns the motion.

use std::time::{Duration, Instant};

use serde::Serialize;

/// The number of a client, unique while the server runs.
pub type ClientId = u64;

/// The owner of the motion.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Owner {
    pub client: ClientId,
    pub name: String,
}

/// The lease of the motion. Its holder must speak within its time, except where it never expires.
#[derive(Debug, Default)]
pub struct Lease {
    held: Option<Held>,
}

#[derive(Debug)]
struct Held {
    owner: Owner,
    /// `None`: never expires.
    ttl: Option<Duration>,
    renewed: Instant,
}

/// Why a client may not command.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LeaseError {
    /// No client holds the lease.
    NoLease,
    /// Another client holds it.
    NotOwner(Owner),
}

impl Lease {
    /// Gives the lease to a client. Returns the previous holder if it was another client.
    ///
    /// # Errors
    /// Fails without `force` if another client holds the lease.
    pub fn take(
        &mut self,
        owner: Owner,
        ttl: Option<Duration>,
        force: bool,
        now: Instant,
    ) -> Result<Option<Owner>, LeaseError> {
        let other = |held: &Held| held.owner.client != owner.client;
        if let Some(held) = self.held.as_ref().filter(|held| other(held))
            && !force
        {
            return Err(LeaseError::NotOwner(held.owner.clone()));
        }
        let previous = self.held.take().filter(other).map(|held| held.owner);
        self.held = Some(Held {
            owner,
            ttl,
            renewed: now,
        });
        Ok(previous)
    }

    /// Renews the lease if the client holds it.
    pub fn renew(&mut self, client: ClientId, now: Instant) {
        if let Some(held) = &mut self.held
            && held.owner.client == client
        {
            held.renewed = now;
        }
    }

    /// Ends the lease if the client holds it.
    pub fn release(&mut self, client: ClientId) -> Option<Owner> {
        self.held
            .take_if(|held| held.owner.client == client)
            .map(|held| held.owner)
    }

    /// Ends the lease if its holder was silent for too long.
    pub fn expire(&mut self, now: Instant) -> Option<Owner> {
        self.held
            .take_if(|held| held.remaining(now) == Some(Duration::ZERO))
            .map(|held| held.owner)
    }

    /// Checks that the client holds the lease.
    ///
    /// # Errors
    /// [`LeaseError`].
    pub fn check(&self, client: ClientId) -> Result<(), LeaseError> {
        match &self.held {
            None => Err(LeaseError::NoLease),
            Some(held) if held.owner.client == client => Ok(()),
            Some(held) => Err(LeaseError::NotOwner(held.owner.clone())),
        }
    }

    /// Returns the holder, and the time until the lease expires.
    #[must_use]
    pub fn holder(&self, now: Instant) -> Option<(&Owner, Option<Duration>)> {
        let held = self.held.as_ref()?;
        Some((&held.owner, held.remaining(now)))
    }
}

impl Held {
    fn remaining(&self, now: Instant) -> Option<Duration> {
        let silent = now.saturating_duration_since(self.renewed);
        Some(self.ttl?.saturating_sub(silent))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn owner(client: ClientId) -> Owner {
        Owner {
            client,
            name: format!("client {client}"),
        }
    }

    const TTL: Option<Duration> = Some(Duration::from_millis(500));

    #[test]
    fn one_client_holds_the_lease() {
        let (mut lease, now) = (Lease::default(), Instant::now());
        assert_eq!(lease.check(1), Err(LeaseError::NoLease));
        assert_eq!(lease.take(owner(1), TTL, false, now), Ok(None));
        assert_eq!(lease.check(1), Ok(()));
        assert_eq!(lease.check(2), Err(LeaseError::NotOwner(owner(1))));
        let refused = lease.take(owner(2), TTL, false, now);
        assert_eq!(refused, Err(LeaseError::NotOwner(owner(1))));
        assert_eq!(lease.release(2), None);
        assert_eq!(lease.take(owner(1), TTL, false, now), Ok(None));
        assert_eq!(lease.take(owner(2), TTL, true, now), Ok(Some(owner(1))));
        assert_eq!(lease.check(1), Err(LeaseError::NotOwner(owner(2))));
        assert_eq!(lease.release(2), Some(owner(2)));
    }

    #[test]
    fn a_silent_owner_loses_the_lease() {
        let (mut lease, start) = (Lease::default(), Instant::now());
        let at = |ms: u64| start + Duration::from_millis(ms);
        lease.take(owner(1), TTL, false, start).unwrap();
        assert_eq!(lease.expire(at(499)), None);
        lease.renew(2, at(499));
        lease.renew(1, at(499));
        assert_eq!(lease.expire(at(998)), None);
        assert_eq!(lease.expire(at(999)), Some(owner(1)));
        assert_eq!(lease.check(1), Err(LeaseError::NoLease));
        lease.take(owner(1), None, false, start).unwrap();
        assert_eq!(lease.expire(at(1 << 40)), None);
    }
}
