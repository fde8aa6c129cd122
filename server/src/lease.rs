//! Who owns the motion.

use std::time::{Duration, Instant};

use serde::Serialize;

use crate::tokens::same;

/// The number of a client, unique while the server runs.
pub type ClientId = u64;

/// The owner of the motion.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Owner {
    pub client: ClientId,
    pub name: String,
}

/// What a request says of its sender.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Claim {
    /// The client, unless several programs share it (HTTP).
    pub client: Option<ClientId>,
    /// The secret of a lease, on any connection. Without it, the client counts.
    pub secret: Option<String>,
}

/// The lease of the motion. Its holder must speak within its time, except where it never expires.
#[derive(Debug, Default)]
pub struct Lease {
    held: Option<Held>,
    /// The last one that has expired.
    expired: Option<Held>,
}

#[derive(Debug)]
struct Held {
    owner: Owner,
    secret: String,
    /// `None`: never expires.
    ttl: Option<Duration>,
    renewed: Instant,
}

/// Why a client may not command.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LeaseError {
    /// No client holds the lease.
    NoLease,
    /// The client's own lease has expired.
    Expired {
        /// The time since the last message that renewed it.
        silent: Duration,
        ttl: Duration,
    },
    /// Another client holds it.
    NotOwner(Owner),
}

impl Lease {
    /// Gives the lease to a client. Returns its secret, and the previous holder if it was another
    /// client. A holder that takes the lease again keeps its secret.
    ///
    /// # Errors
    /// Fails without `force` if another client holds the lease.
    pub fn take(
        &mut self,
        claim: &Claim,
        owner: Owner,
        secret: String,
        ttl: Option<Duration>,
        force: bool,
        now: Instant,
    ) -> Result<(String, Option<Owner>), LeaseError> {
        if let Some(held) = self.held.as_mut().filter(|held| held.is_claimed(claim)) {
            held.owner.name = owner.name;
            (held.ttl, held.renewed) = (ttl, now);
            return Ok((held.secret.clone(), None));
        }
        if let Some(held) = self.held.as_ref().filter(|_| !force) {
            return Err(LeaseError::NotOwner(held.owner.clone()));
        }
        let previous = self.held.replace(Held {
            owner,
            secret: secret.clone(),
            ttl,
            renewed: now,
        });
        self.expired = None;
        Ok((secret, previous.map(|held| held.owner)))
    }

    /// Renews the lease if the sender holds it.
    pub fn renew(&mut self, claim: &Claim, now: Instant) {
        if let Some(held) = self.held.as_mut().filter(|held| held.is_claimed(claim)) {
            held.renewed = now;
        }
    }

    /// Ends the lease if the sender holds it.
    pub fn release(&mut self, claim: &Claim) -> Option<Owner> {
        self.held
            .take_if(|held| held.is_claimed(claim))
            .map(|held| held.owner)
    }

    /// Ends the lease if its holder was silent for too long.
    pub fn expire(&mut self, now: Instant) -> Option<Owner> {
        let expired = self
            .held
            .take_if(|held| held.remaining(now) == Some(Duration::ZERO))?;
        let owner = expired.owner.clone();
        self.expired = Some(expired);
        Some(owner)
    }

    /// Checks that the sender holds the lease.
    ///
    /// # Errors
    /// [`LeaseError`].
    pub fn check(&self, claim: &Claim, now: Instant) -> Result<(), LeaseError> {
        match &self.held {
            Some(held) if held.is_claimed(claim) => Ok(()),
            Some(held) => Err(LeaseError::NotOwner(held.owner.clone())),
            None => {
                let own = self.expired.as_ref().filter(|held| held.is_claimed(claim));
                Err(own.map_or(LeaseError::NoLease, |held| LeaseError::Expired {
                    silent: now.saturating_duration_since(held.renewed),
                    ttl: held.ttl.unwrap_or_default(),
                }))
            }
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

    fn is_claimed(&self, claim: &Claim) -> bool {
        match &claim.secret {
            Some(secret) => same(&self.secret, secret),
            None => claim.client == Some(self.owner.client),
        }
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

    fn by(client: ClientId) -> Claim {
        Claim {
            client: Some(client),
            secret: None,
        }
    }

    fn with(secret: &str) -> Claim {
        Claim {
            client: None,
            secret: Some(secret.to_owned()),
        }
    }

    const TTL: Option<Duration> = Some(Duration::from_millis(500));

    impl Lease {
        fn gives(
            &mut self,
            client: ClientId,
            ttl: Option<Duration>,
            force: bool,
            now: Instant,
        ) -> Result<Option<Owner>, LeaseError> {
            let secret = format!("secret {client}");
            let given = self.take(&by(client), owner(client), secret, ttl, force, now);
            given.map(|(_, previous)| previous)
        }
    }

    #[test]
    fn one_client_holds_the_lease() {
        let (mut lease, now) = (Lease::default(), Instant::now());
        assert_eq!(lease.check(&by(1), now), Err(LeaseError::NoLease));
        assert_eq!(lease.gives(1, TTL, false, now), Ok(None));
        assert_eq!(lease.check(&by(1), now), Ok(()));
        let other = LeaseError::NotOwner(owner(1));
        assert_eq!(lease.check(&by(2), now), Err(other.clone()));
        assert_eq!(lease.gives(2, TTL, false, now), Err(other));
        assert_eq!(lease.release(&by(2)), None);
        assert_eq!(lease.gives(1, TTL, false, now), Ok(None));
        assert_eq!(lease.gives(2, TTL, true, now), Ok(Some(owner(1))));
        assert_eq!(
            lease.check(&by(1), now),
            Err(LeaseError::NotOwner(owner(2)))
        );
        assert_eq!(lease.release(&by(2)), Some(owner(2)));
    }

    #[test]
    fn a_silent_owner_loses_the_lease() {
        let (mut lease, start) = (Lease::default(), Instant::now());
        let at = |ms: u64| start + Duration::from_millis(ms);
        lease.gives(1, TTL, false, start).unwrap();
        assert_eq!(lease.expire(at(499)), None);
        lease.renew(&by(2), at(499));
        lease.renew(&by(1), at(499));
        assert_eq!(lease.expire(at(998)), None);
        assert_eq!(lease.expire(at(999)), Some(owner(1)));
        let expired = LeaseError::Expired {
            silent: Duration::from_millis(2101),
            ttl: Duration::from_millis(500),
        };
        assert_eq!(lease.check(&by(1), at(2600)), Err(expired));
        assert_eq!(lease.check(&by(2), at(2600)), Err(LeaseError::NoLease));
        lease.gives(1, None, false, start).unwrap();
        assert_eq!(lease.expire(at(1 << 40)), None);
    }

    /// Several programs over HTTP are one client: the secret alone makes the owner.
    #[test]
    fn a_secret_is_the_owner_on_any_connection() {
        let (mut lease, now) = (Lease::default(), Instant::now());
        let shared = Claim::default();
        let first = lease.take(&shared, owner(7), "a".to_owned(), TTL, false, now);
        assert_eq!(first, Ok(("a".to_owned(), None)));
        let other = Err(LeaseError::NotOwner(owner(7)));
        assert_eq!(lease.check(&shared, now), other);
        assert_eq!(lease.check(&with("b"), now), other);
        assert_eq!(lease.check(&with("a"), now), Ok(()));
        let again = lease.take(&with("a"), owner(7), "c".to_owned(), TTL, false, now);
        assert_eq!(again, Ok(("a".to_owned(), None)), "it keeps its secret");
        let refused = lease.take(&shared, owner(8), "c".to_owned(), TTL, false, now);
        assert_eq!(refused, Err(LeaseError::NotOwner(owner(7))));
        // A wrong secret is not excused by the connection.
        let stale = Claim {
            client: Some(7),
            ..with("old")
        };
        assert_eq!(lease.check(&stale, now), other);
        assert_eq!(lease.release(&with("a")), Some(owner(7)));
    }
}
