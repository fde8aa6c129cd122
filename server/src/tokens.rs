//! The tokens of HTTP, and what each of them permits.

use axum::http::{HeaderMap, Uri, header};

use crate::error::{ErrorCode, OpError};

/// The tokens of a server. Each one permits reading.
#[derive(Debug)]
pub struct Tokens {
    commanding: Option<String>,
    reading: Vec<String>,
    /// Why the reading ones permit no commands.
    refusal: OpError,
}

/// What a client with a token may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rights {
    Command,
    Read,
}

impl Tokens {
    /// `control`: the token permits commands. The watch token never does.
    #[must_use]
    pub fn new(token: String, watch: Option<String>, control: bool) -> Self {
        let refusal = |message: &str| OpError::new(ErrorCode::ReadOnly, message);
        match control {
            true => Self {
                commanding: Some(token),
                reading: watch.into_iter().collect(),
                refusal: refusal("this token permits no commands")
                    .help("use the token that permits commands"),
            },
            false => Self {
                commanding: None,
                reading: watch.into_iter().chain([token]).collect(),
                refusal: refusal("the server takes no commands over HTTP")
                    .help("start it with --control"),
            },
        }
    }

    /// Returns the rights of a client with this token; `None` if it is wrong.
    #[must_use]
    pub fn rights(&self, given: &str) -> Option<Rights> {
        // All are compared, in any case.
        let is = |known: &String| same(known, given);
        let commands = self.commanding.iter().filter(|known| is(known)).count();
        let reads = self.reading.iter().filter(|known| is(known)).count();
        match (commands, reads) {
            (0, 0) => None,
            (0, _) => Some(Rights::Read),
            _ => Some(Rights::Command),
        }
    }

    /// Returns why these rights permit no commands.
    #[must_use]
    pub fn refusal(&self, rights: Rights) -> Option<OpError> {
        (rights == Rights::Read).then(|| self.refusal.clone())
    }

    /// As [`Tokens::rights`], of the `Authorization` header.
    #[must_use]
    pub fn rights_of(&self, headers: &HeaderMap) -> Option<Rights> {
        let given = headers.get(header::AUTHORIZATION)?.to_str().ok()?;
        self.rights(given.strip_prefix("Bearer ")?.trim())
    }

    /// Returns whether the address contains a token, as `?token=TOKEN`: viewers in a browser cannot
    /// set headers.
    #[must_use]
    pub fn are_in(&self, address: &Uri) -> bool {
        let mut keys = address.query().unwrap_or_default().split('&');
        keys.any(|key| {
            key.strip_prefix("token=")
                .is_some_and(|given| self.rights(given).is_some())
        })
    }
}

/// Compares in a time that does not depend on the place of the first difference.
#[must_use]
pub(crate) fn same(known: &str, given: &str) -> bool {
    let (known, given) = (known.as_bytes(), given.as_bytes());
    let difference = known
        .iter()
        .zip(given)
        .fold(0, |difference, (a, b)| difference | (a ^ b));
    known.len() == given.len() && difference == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_token_permits_what_it_is_for() {
        let tokens = Tokens::new("command".into(), Some("watch".into()), true);
        assert_eq!(tokens.rights("command"), Some(Rights::Command));
        assert_eq!(tokens.rights("watch"), Some(Rights::Read));
        for wrong in ["", "comman", "commands", "watc", "watch ", "COMMAND"] {
            assert_eq!(tokens.rights(wrong), None, "{wrong}");
        }
        assert_eq!(tokens.refusal(Rights::Command), None);
        let refusal = tokens.refusal(Rights::Read).map(|error| error.code);
        assert_eq!(refusal, Some(ErrorCode::ReadOnly));
        let reads = Tokens::new("token".into(), None, false);
        assert_eq!(reads.rights("token"), Some(Rights::Read));
        assert_eq!(reads.rights("watch"), None);
    }
}
