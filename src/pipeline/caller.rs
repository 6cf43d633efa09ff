//! Who a request is from, as far as sharing the service is concerned.

use std::net::{IpAddr, Ipv6Addr};
use std::sync::Arc;

/// Bits of an IPv6 address that name a network. The others are the host's to choose, so that one
/// host has as many addresses as it likes.
const NETWORK_BITS: u32 = 64;

/// Who a request is from. Requests of one caller are served in their order; callers take turns.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Caller {
    /// The holder of the keys with this name.
    Key(Arc<str>),
    /// Anyone at this address, if the service has no keys. See [`network_of`].
    Network(IpAddr),
    /// The process itself, such as an import straight into its own store.
    Local,
}

/// The address that stands for everyone who shares it: an IPv4 address as it is, also where it is
/// written as one of IPv6; of any other IPv6 address its network of 64 bits.
pub fn network_of(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V4(address) => IpAddr::V4(address),
        IpAddr::V6(address) => {
            let mask = u128::MAX << (u128::BITS - NETWORK_BITS);
            IpAddr::V6(Ipv6Addr::from_bits(address.to_bits() & mask))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hosts_of_one_network_of_ipv6_are_one_and_addresses_of_ipv4_are_many() {
        let network = |text: &str| network_of(text.parse().unwrap());
        assert_eq!(
            network("2001:db8:1:2:3:4:5:6"),
            network("2001:db8:1:2:ffff::1")
        );
        assert_ne!(network("2001:db8:1:2::1"), network("2001:db8:1:3::1"));
        assert_eq!(network("::ffff:10.0.0.1"), network("10.0.0.1"));
        assert_ne!(network("::ffff:10.0.0.1"), network("::ffff:10.0.0.2"));
        assert_ne!(network("10.0.0.1"), network("10.0.0.2"));
    }
}
