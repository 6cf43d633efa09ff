use super::*;
use half::f16;
use placeformer_core::types::{PatchGrid, PoolingStride};

fn patches(index: Vec<u16>, counts: [usize; 3]) -> PackedPatches {
    let n = index.len();
    let grid = PatchGrid {
        columns: 32,
        rows: 24,
        patch_px: 14,
        stride: PoolingStride::Kernel,
    };
    let attention = vec![f16::ONE; n];
    let factor = vec![1.0; n];
    let codes = vec![1; n];
    PackedPatches {
        grid,
        dim: 1,
        counts,
        index,
        attention,
        factor,
        codes,
    }
}

fn grey() -> RgbImage {
    RgbImage::filled(
        ImageSize {
            width: 640,
            height: 480,
        },
        [60, 60, 60],
    )
}

#[test]
fn rows_and_panels_add_up_and_lines_join_the_patches() {
    let image = grey();
    let patches = patches(vec![32 * 12 + 16, 0], [1, 1, 0]);
    let side = DrawnSide {
        image: &image,
        attention: None,
        patches: &patches,
    };
    let scales: ScaleSet = "1+2".parse().unwrap();
    let lines = CombinationLines {
        scales,
        matches: 9,
        inliers: &[(0, 0)],
    };
    let picture = match_picture(&side, &side, &[lines, lines]).unwrap();
    assert_eq!(
        picture.size,
        ImageSize {
            width: 480 * 2 + 24,
            height: 8 + 360 + 8 + 2 * 392
        }
    );
    // The patch lies at 231, 175 of 448 x 336, so at 247.5, 187.5 of a panel of 480 x 360.
    let top = 8 + 360 + 8 + 24;
    let left_x = 8 + 247;
    let right_x = 16 + 480 + 247;
    let y = top + 187;
    assert_eq!(picture.pixel(left_x, y), [94, 231, 138]);
    assert_eq!(picture.pixel(right_x, y), [94, 231, 138]);
    let between = picture.pixel((left_x + right_x) / 2, y);
    assert!(between[1] > 150 && between[0] < between[1], "{between:?}");
    assert_eq!(picture.pixel(left_x, y + 40), [60, 60, 60]);
    assert_eq!(picture.pixel(left_x, y + 392), [255, 179, 71]);
}

#[test]
fn key_patches_are_outlined_in_the_colour_of_their_scale() {
    let image = grey();
    let patches = patches(vec![0, 15], [0, 1, 1]);
    let side = DrawnSide {
        image: &image,
        attention: None,
        patches: &patches,
    };
    let picture = match_picture(&side, &side, &[]).unwrap();
    // The first 2x2 window spans 30 x 30 pixels of the panel at 8, 8; its outline is inset by
    // 1.5.
    let edge = picture.pixel(8 + 15, 8 + 1);
    assert!(edge[0] > 150 && edge[2] < 120, "{edge:?}");
    assert_eq!(picture.pixel(8 + 15, 8 + 15), [60, 60, 60]);
}

#[test]
fn heat_is_where_the_attention_is() {
    let mut values = vec![0.1; 12];
    values[5] = 5.0;
    let picture = attention_picture(
        &grey(),
        AttentionMap {
            values: &values,
            columns: 4,
            rows: 3,
        },
    )
    .unwrap();
    let hot = picture.pixel(240, 240);
    let cold = picture.pixel(600, 440);
    assert!(hot[0] > cold[0] + 60, "{hot:?} {cold:?}");
}

#[test]
fn what_does_not_fit_is_refused() {
    let image = grey();
    let patches = patches(vec![0], [1, 0, 0]);
    let map = AttentionMap {
        values: &[1.0; 5],
        columns: 2,
        rows: 3,
    };
    assert!(matches!(
        attention_picture(&image, map),
        Err(DrawError::AttentionShape { values: 5, .. })
    ));
    let side = DrawnSide {
        image: &image,
        attention: None,
        patches: &patches,
    };
    let lines = CombinationLines {
        scales: "1".parse().unwrap(),
        matches: 1,
        inliers: &[(0, 1)],
    };
    let error = match_picture(&side, &side, &[lines]).unwrap_err();
    assert_eq!(error, DrawError::NoSuchPatch { row: 1, patches: 1 });
    let empty = RgbImage {
        size: ImageSize {
            width: 0,
            height: 3,
        },
        pixels: vec![],
    };
    let side = DrawnSide {
        image: &empty,
        ..side
    };
    assert!(matches!(
        match_picture(&side, &side, &[]),
        Err(DrawError::Size(_))
    ));
}
