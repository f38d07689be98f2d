//! The response of a silent member's host to a connection attempt to its GNCL.

/// A response of a host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Host {
    /// The host accepts the connection, whether or not the node's process runs.
    Accepts,
    /// No process listens there: the node's process has ended.
    Refuses,
    /// No response in time, or no route to the host.
    IsSilent,
}

impl Host {
    /// Returns the response of a host from those of its addresses. One acceptance is enough. One refusal is
    /// not, because another host may have that address. Or the path to it may be closed, while the process is
    /// alive and listens at another one. // spec: NDL-4.6
    pub fn by(responses: impl IntoIterator<Item = Self>) -> Self {
        let mut of_all = None;
        for response in responses {
            of_all = match (of_all, response) {
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
    fn host_refuses_by_all_addresses_and_accepts_by_one() {
        let cases: [(&[Host], Host); 7] = [
            (&[], IsSilent),
            (&[Refuses], Refuses),
            (&[Refuses, Refuses], Refuses),
            (&[Refuses, IsSilent], IsSilent),
            (&[IsSilent, Refuses], IsSilent),
            (&[Refuses, IsSilent, Accepts], Accepts),
            (&[Accepts, Refuses], Accepts),
        ];
        for (responses, host) in cases {
            assert_eq!(Host::by(responses.iter().copied()), host, "{responses:?}");
        }
    }
}
