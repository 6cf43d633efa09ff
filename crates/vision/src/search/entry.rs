//! What goes into an index, and what comes out.

use placeformer_core::types::{Altitude, GLOBAL_DIM, GeoPoint, Heading, ReferenceId, Timestamp};

/// One reference of a map, as the index needs it.
#[derive(Debug, Clone, PartialEq)]
pub struct IndexEntry {
    /// Identity.
    pub id: ReferenceId,
    /// Global descriptor, `[256]`.
    pub global: Vec<f32>,
    /// Where it was taken, for the geographic filter.
    pub location: Option<GeoPoint>,
    /// How high it was taken, for estimates; kept to a centimetre.
    pub alt: Option<Altitude>,
    /// Where its camera looked, for tracks; kept to a hundred-thousandth of a degree.
    pub heading: Option<Heading>,
    /// When it was taken, for the time filter.
    pub captured_at: Option<Timestamp>,
}

impl IndexEntry {
    /// # Panics
    /// If the descriptor's length is not 256.
    pub(super) fn assert_length(&self) {
        assert_eq!(
            self.global.len(),
            GLOBAL_DIM,
            "length of the descriptor of {}",
            self.id
        );
    }
}

/// A reference with the place where it was taken.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocatedReference {
    /// Identity.
    pub id: ReferenceId,
    /// Where it was taken.
    pub location: GeoPoint,
    /// How high it was taken, if that is known.
    pub alt: Option<Altitude>,
    /// Where its camera looked, if that is known.
    pub heading: Option<Heading>,
}

/// A reference that a search found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighbour {
    /// Identity.
    pub id: ReferenceId,
    /// Euclidean distance between the global descriptors.
    pub distance: f32,
}
