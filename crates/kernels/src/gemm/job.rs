//! The arguments of a product after their checks.

use super::{RightPanel, Tiling, covers};
use crate::Simd;
use crate::operand::WordRows;

/// A block of rows times one panel.
///
/// The fields are private to this file, because the matrix instructions of AMX read and write
/// through pointers and rely on these facts, which [`new`](Self::new) checks: `rows` is positive
/// and a multiple of the level's row step; `left` holds `rows` rows of `k` words; `right` holds
/// every segment; `out` holds `rows` rows of the panel's width.
pub(super) struct PanelJob<'a> {
    rows: usize,
    columns: usize,
    left: WordRows<'a>,
    right: RightPanel<'a>,
    out: &'a mut [u32],
    out_stride: usize,
    accumulates: bool,
}

impl<'a> PanelJob<'a> {
    /// # Panics
    /// If `rows` is not a multiple of the level's row step, or a slice is too short.
    pub(super) fn new(
        simd: Simd,
        rows: usize,
        left: WordRows<'a>,
        right: RightPanel<'a>,
        out: &'a mut [u32],
        out_stride: usize,
    ) -> Self {
        let tile = Tiling::of(simd);
        let columns = tile.columns;
        assert_eq!(rows % tile.row_step, 0, "rows must be whole steps");
        assert!(
            covers(left.data.len(), rows, left.stride, right.k),
            "left-hand side too short"
        );
        let extent = right.extent(columns);
        assert!(
            extent.is_some_and(|extent| right.data.len() >= extent),
            "panel too short"
        );
        assert!(
            covers(out.len(), rows, out_stride, columns),
            "result too short"
        );
        Self {
            rows,
            columns,
            left,
            right,
            out,
            out_stride,
            accumulates: false,
        }
    }

    /// Rows of the left-hand side.
    pub(super) fn rows(&self) -> usize {
        self.rows
    }

    /// Length of the sums in words.
    #[cfg(target_arch = "x86_64")]
    pub(super) fn k(&self) -> usize {
        self.right.k
    }

    /// Rows of a segment of the panel.
    #[cfg(target_arch = "x86_64")]
    pub(super) fn segment_rows(&self) -> usize {
        self.right.segment_rows
    }

    /// Words from one row of the left-hand side to the next.
    pub(super) fn left_stride(&self) -> usize {
        self.left.stride
    }

    /// Elements from one row of the result to the next.
    pub(super) fn out_stride(&self) -> usize {
        self.out_stride
    }

    /// Whether the sums start from what the result holds, instead of zero.
    pub(super) fn accumulates(&self) -> bool {
        self.accumulates
    }

    /// The left-hand side from one row on.
    #[inline(always)]
    pub(super) fn left_from(&self, row: usize) -> &'a [u32] {
        &self.left.data[row * self.left.stride..]
    }

    /// The result from one row on.
    #[inline(always)]
    pub(super) fn out_from(&mut self, row: usize) -> &mut [u32] {
        &mut self.out[row * self.out_stride..]
    }

    /// The segments of the panel: where in k each starts, and its words, `[rows, columns]`.
    #[inline(always)]
    pub(super) fn segments(&self) -> impl Iterator<Item = (usize, &'a [u32])> + use<'a> {
        let RightPanel {
            data,
            k,
            segment_rows,
            segment_stride,
        } = self.right;
        let columns = self.columns;
        (0..k)
            .step_by(segment_rows.max(1))
            .enumerate()
            .map(move |(segment, start)| {
                let count = segment_rows.min(k - start);
                (start, &data[segment * segment_stride..][..count * columns])
            })
    }

    /// The same product over the first `k` words only.
    #[cfg(target_arch = "x86_64")]
    pub(super) fn shortened(&mut self, k: usize) -> PanelJob<'_> {
        assert!(k <= self.right.k);
        PanelJob {
            right: RightPanel { k, ..self.right },
            out: &mut *self.out,
            ..*self
        }
    }

    /// What is left of the product after its first `k` words, which must end in the last segment of
    /// the panel; its sums are added to the result.
    #[cfg(target_arch = "x86_64")]
    pub(super) fn remainder(&mut self, k: usize) -> PanelJob<'_> {
        let RightPanel {
            segment_rows,
            segment_stride,
            ..
        } = self.right;
        let segment = k / segment_rows;
        let row = k % segment_rows;
        let left = &self.left.data[k..];
        let right = &self.right.data[segment * segment_stride + row * self.columns..];
        let rest = self.right.k - k;
        assert!(row + rest <= segment_rows);
        PanelJob {
            left: WordRows {
                data: left,
                stride: self.left.stride,
            },
            right: RightPanel::whole(right, rest),
            out: &mut *self.out,
            accumulates: true,
            ..*self
        }
    }
}
