//! How the times of certificates are used while the clock may be wrong.

/// The policy for certificate times on a machine with a clock that may be wrong.
///
/// # Examples
///
/// ```
/// use sinew::{NodeConfig, security::TimePolicy};
///
/// let mut config = NodeConfig::new("knee");
/// // GPS sets the clock of this host before Sinew starts.
/// config.security.times = TimePolicy::Strict;
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum TimePolicy {
    /// A certificate is valid from its first to its last second. While the clock is known not to be set, no
    /// certificate is valid and no link is made.
    Strict,
    /// Same as [`Strict`](Self::Strict) while the clock is set. While the clock is known not to be set, a
    /// certificate is valid if it had not expired when this node's own was made. An attacker with control of
    /// the clock can then use a certificate that expired since. The deny list applies in any case.
    #[default]
    UntilSet,
    /// Times are not checked. Only the deny list ends a certificate.
    Ignored,
}

impl TimePolicy {
    /// Returns the value of this policy in a configuration.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Strict => "strict",
            Self::UntilSet => "until-set",
            Self::Ignored => "ignored",
        }
    }
}

impl std::str::FromStr for TimePolicy {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        [Self::Strict, Self::UntilSet, Self::Ignored]
            .into_iter()
            .find(|policy| policy.word() == text)
            .ok_or(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_policy_round_trips() {
        for policy in [TimePolicy::Strict, TimePolicy::UntilSet, TimePolicy::Ignored] {
            assert_eq!(policy.word().parse(), Ok(policy));
        }
        assert_eq!("Strict".parse::<TimePolicy>(), Err(()));
    }
}
