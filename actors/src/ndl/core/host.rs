//! What the host of a silent member says when a connection to its GNCL is tried.

/// What a host says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Host {
    /// The connection is made: by the host, whether or not the node's process runs.
    Accepts,
    /// Nobody listens there: the process has ended.
    Refuses,
    /// Nothing, in the time that it had; or it cannot be sent to.
    IsSilent,
}

impl Host {
    /// What a host says, by what is said at each of its addresses: one that accepts is enough. One that refuses is not: another host may have
    /// that address, or the way to it be closed, while the process lives and listens at the next. // spec: NDL-4.6
    pub(in crate::ndl) fn by(said: impl IntoIterator<Item = Self>) -> Self {
        let mut of_all = None;
        for one in said {
            of_all = match (of_all, one) {
                (_, Self::Accepts) => return Self::Accepts,
                (None | Some(Self::Refuses), Self::Refuses) => Some(Self::Refuses),
                (_, Self::Refuses | Self::IsSilent) => Some(Self::IsSilent),
            };
        }
        of_all.unwrap_or(Self::IsSilent)
    }
}

#[cfg(test)]
mod tests {
    use super::Host::{self, Accepts, IsSilent, Refuses};

    // spec: NDL-4.6
    #[test]
    fn a_host_refuses_only_if_it_does_at_each_of_its_addresses_and_accepts_if_it_does_at_one() {
        let cases: [(&[Host], Host); 7] = [
            (&[], IsSilent),
            (&[Refuses], Refuses),
            (&[Refuses, Refuses], Refuses),
            (&[Refuses, IsSilent], IsSilent),
            (&[IsSilent, Refuses], IsSilent),
            (&[Refuses, IsSilent, Accepts], Accepts),
            (&[Accepts, Refuses], Accepts),
        ];
        for (said, host) in cases {
            assert_eq!(Host::by(said.iter().copied()), host, "{said:?}");
        }
    }
}
