//! Which connections may be open: bounded in all and by address, with some kept for probes, and the
//! idlest ended for the sake of a new one.
//!
//! Without this, whoever opens many connections and says nothing would shut everybody else out, the
//! supervisor's probes included. A connection without a request is worth less than a new client, so
//! it has to go; of several, one of the address that has most. Where nothing is idle, the new
//! client gets one of a few connections that are kept for probes.

use super::activity::Activity;
use crate::http::config::HttpConfig;
use crate::ops::Metrics;
use crate::ops::metrics::{ConnectionCut, ConnectionKind};
use crate::pipeline::network_of;
use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// All open connections.
pub(super) struct Connections {
    open: Mutex<Open>,
    limits: Limits,
    metrics: Arc<Metrics>,
}

struct Limits {
    general: usize,
    reserved: usize,
    per_address: usize,
    trusted: Vec<IpAddr>,
    crowded_silence: Duration,
}

#[derive(Default)]
struct Open {
    by_id: HashMap<u64, Entry>,
    /// How many general connections each address has; those without any are missing.
    by_address: HashMap<IpAddr, usize>,
    general: usize,
    reserved: usize,
    next_id: u64,
}

struct Entry {
    address: IpAddr,
    kind: ConnectionKind,
    activity: Arc<Activity>,
    evicted: CancellationToken,
}

/// The place of one connection among those that may be open; given up when dropped.
pub(super) struct Place {
    id: u64,
    /// What the connection may be used for.
    pub(super) kind: ConnectionKind,
    /// What it is doing; its task keeps this up to date.
    pub(super) activity: Arc<Activity>,
    /// Cancelled when its place is given to another.
    pub(super) evicted: CancellationToken,
    connections: Arc<Connections>,
}

impl Connections {
    /// No connections yet.
    pub(super) fn new(config: &HttpConfig, metrics: Arc<Metrics>) -> Arc<Self> {
        Arc::new(Self {
            open: Mutex::default(),
            limits: Limits {
                general: config.max_connections,
                reserved: config.reserved_connections,
                per_address: config.max_connections_per_address,
                trusted: config.trusted_proxies.clone(),
                crowded_silence: Duration::from_millis(config.crowded_silence_ms),
            },
            metrics,
        })
    }

    /// Every change of the table is completed under the lock and cannot panic half-way.
    fn open(&self) -> MutexGuard<'_, Open> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A place for a connection from `peer`; `None` if it cannot even have a reserved one.
    pub(super) fn admit(self: &Arc<Self>, peer: IpAddr) -> Option<Place> {
        let address = network_of(peer);
        let mut open = self.open();
        self.end_silent(&mut open);
        let Some(kind) = self.kind_for(&mut open, peer, address) else {
            self.metrics.connection_cut(ConnectionCut::Refused);
            return None;
        };
        let place = Place {
            id: open.next_id,
            kind,
            activity: Arc::new(Activity::new()),
            evicted: CancellationToken::new(),
            connections: self.clone(),
        };
        let entry = Entry {
            address,
            kind,
            activity: place.activity.clone(),
            evicted: place.evicted.clone(),
        };
        open.insert(entry);
        self.show(&open);
        Some(place)
    }

    /// Ends the idlest connection, for the sake of file descriptors that have run out.
    pub(super) fn end_idlest(&self) {
        let mut open = self.open();
        self.evict(&mut open, |entry, _| entry.activity.idle_time());
        self.show(&open);
    }

    /// The kind of place there is for a new connection, which may be another's until now.
    fn kind_for(&self, open: &mut Open, peer: IpAddr, address: IpAddr) -> Option<ConnectionKind> {
        let is_trusted = self.limits.trusted.contains(&peer.to_canonical());
        let own = open.by_address.get(&address).copied().unwrap_or(0);
        let has_place = if !is_trusted && own >= self.limits.per_address {
            self.evict(open, |entry, _| entry.general_of(Some(address)))
        } else if open.general >= self.limits.general {
            self.evict(open, |entry, _| entry.general_of(None))
        } else {
            true
        };
        if has_place {
            return Some(ConnectionKind::General);
        }
        let has_place = open.reserved < self.limits.reserved
            || self.evict(open, |entry, _| entry.waiting_in_reserve());
        has_place.then_some(ConnectionKind::Reserved)
    }

    /// While it is crowded, ends all connections that have been silent for too long.
    fn end_silent(&self, open: &mut Open) {
        if open.general <= self.limits.general / 4 * 3 {
            return;
        }
        let longest = self.limits.crowded_silence;
        let is_silent = |entry: &Entry| {
            let silent = entry.activity.silent_time();
            silent.is_some_and(|time| time >= longest)
        };
        let silent: Vec<u64> = open.ids(|entry| is_silent(entry)).collect();
        for id in silent {
            self.end(open, id, ConnectionCut::Silent);
        }
    }

    /// Ends one of the connections for which `time` gives how long they could have been ended: of
    /// the address that has most, the one of the longest time. Returns whether there is one.
    fn evict(&self, open: &mut Open, time: impl Fn(&Entry, u64) -> Option<Duration>) -> bool {
        let candidates = open.by_id.iter().filter_map(|(&id, entry)| {
            let own = open.by_address.get(&entry.address).copied().unwrap_or(0);
            Some(((own, time(entry, id)?), id))
        });
        let Some((_, id)) = candidates.max() else {
            return false;
        };
        self.end(open, id, ConnectionCut::Evicted);
        true
    }

    fn end(&self, open: &mut Open, id: u64, why: ConnectionCut) {
        if let Some(entry) = open.remove(id) {
            entry.evicted.cancel();
            self.metrics.connection_cut(why);
        }
    }

    fn show(&self, open: &Open) {
        self.metrics
            .set_connections(ConnectionKind::General, open.general);
        self.metrics
            .set_connections(ConnectionKind::Reserved, open.reserved);
    }
}

impl Entry {
    /// How long this connection has been idle, if it is a general one (of that address).
    fn general_of(&self, address: Option<IpAddr>) -> Option<Duration> {
        let is_meant = address.is_none_or(|address| address == self.address);
        if self.kind != ConnectionKind::General || !is_meant {
            return None;
        }
        self.activity.idle_time()
    }

    /// How long this connection has kept the server waiting, if it is a reserved one.
    fn waiting_in_reserve(&self) -> Option<Duration> {
        match self.kind {
            ConnectionKind::General => None,
            ConnectionKind::Reserved => self.activity.waiting_time(),
        }
    }
}

impl Open {
    fn ids(&self, is_meant: impl Fn(&Entry) -> bool) -> impl Iterator<Item = u64> {
        let meant = self.by_id.iter().filter(move |(_, entry)| is_meant(entry));
        meant.map(|(&id, _)| id)
    }

    fn insert(&mut self, entry: Entry) {
        match entry.kind {
            ConnectionKind::General => {
                self.general += 1;
                *self.by_address.entry(entry.address).or_default() += 1;
            }
            ConnectionKind::Reserved => self.reserved += 1,
        }
        self.by_id.insert(self.next_id, entry);
        self.next_id += 1;
    }

    fn remove(&mut self, id: u64) -> Option<Entry> {
        let entry = self.by_id.remove(&id)?;
        match entry.kind {
            ConnectionKind::General => {
                self.general -= 1;
                self.forget_one_of(entry.address);
            }
            ConnectionKind::Reserved => self.reserved -= 1,
        }
        Some(entry)
    }

    fn forget_one_of(&mut self, address: IpAddr) {
        if let Some(count) = self.by_address.get_mut(&address) {
            *count -= 1;
            if *count == 0 {
                self.by_address.remove(&address);
            }
        }
    }
}

impl Place {
    /// Whether the connection, whose place was given to another, can be ended at once. It may have
    /// got a request since it was chosen, which is then answered.
    pub(super) fn can_end_at_once(&self) -> bool {
        let time = match self.kind {
            ConnectionKind::General => self.activity.idle_time(),
            ConnectionKind::Reserved => self.activity.waiting_time(),
        };
        time.is_some()
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut open = self.connections.open();
        // It is gone already if its place was given to another.
        open.remove(self.id);
        self.connections.show(&open);
    }
}
