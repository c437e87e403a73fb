//! Image files: PNG for colour, 16-bit PNG for depth and segmentation.

use std::io::Cursor;

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder as _};

use super::RecordError;
use crate::vision::ImageSize;

/// Encodes RGB (three bytes per pixel, top row first) as PNG.
///
/// # Errors
/// [`RecordError::Image`] for a buffer of the wrong length.
pub fn png_rgb(size: ImageSize, rgb: &[u8]) -> Result<Vec<u8>, RecordError> {
    encode(size, rgb, ExtendedColorType::Rgb8, 3)
}

/// Encodes RGBA (four bytes per pixel, top row first) as PNG.
///
/// # Errors
/// Returns the errors of [`png_rgb`].
pub fn png_rgba(size: ImageSize, rgba: &[u8]) -> Result<Vec<u8>, RecordError> {
    encode(size, rgba, ExtendedColorType::Rgba8, 4)
}

/// Encodes depth (m) as 16-bit PNG in millimetres. Depths beyond 65.535 m are 0.
///
/// # Errors
/// Returns the errors of [`png_rgb`].
pub fn png_depth(size: ImageSize, depth: &[f32]) -> Result<Vec<u8>, RecordError> {
    let millimetres = depth.iter().map(|&metres| {
        let rounded = (f64::from(metres) * 1000.0).round();
        if (0.0..=65_535.0).contains(&rounded) { rounded as u16 } else { 0 }
    });
    png_u16(size, millimetres)
}

/// Encodes a segmentation image of a [`SceneRenderer`](crate::vision::SceneRenderer) as 16-bit PNG. The value is
/// the index plus one; the background is 0.
///
/// # Errors
/// Returns the errors of [`png_rgb`].
pub fn png_segmentation(size: ImageSize, objects: &[[i32; 2]]) -> Result<Vec<u8>, RecordError> {
    png_u16(size, objects.iter().map(|[_, index]| u16::try_from(index + 1).unwrap_or(0)))
}

fn png_u16(size: ImageSize, values: impl Iterator<Item = u16>) -> Result<Vec<u8>, RecordError> {
    // the encoder takes native byte order and writes big-endian
    let bytes: Vec<u8> = values.flat_map(u16::to_ne_bytes).collect();
    encode(size, &bytes, ExtendedColorType::L16, 2)
}

fn encode(size: ImageSize, bytes: &[u8], color: ExtendedColorType, per_pixel: usize) -> Result<Vec<u8>, RecordError> {
    check(size, bytes.len(), per_pixel)?;
    let mut out = Cursor::new(Vec::new());
    PngEncoder::new_with_quality(&mut out, CompressionType::Fast, FilterType::Adaptive).write_image(
        bytes,
        size.width,
        size.height,
        color,
    )?;
    Ok(out.into_inner())
}

pub(super) fn check(size: ImageSize, got: usize, per_pixel: usize) -> Result<(), RecordError> {
    let expected = size.pixels() * per_pixel;
    if got == expected { Ok(()) } else { Err(RecordError::Image { size, got, expected }) }
}

/// Converts depth (m) to RGB colours, from light (near) to dark (far). The background is black.
///
/// The scale is logarithmic between the nearest and the farthest depth in the image. `far` is the depth of the
/// background.
pub fn depth_in_colour(depth: &[f32], far: f32) -> Vec<u8> {
    // anchors of the perceptually uniform colour map viridis, from dark to light
    const ANCHORS: [[f32; 3]; 9] = [
        [68.0, 1.0, 84.0],
        [71.0, 44.0, 122.0],
        [59.0, 81.0, 139.0],
        [44.0, 113.0, 142.0],
        [33.0, 144.0, 141.0],
        [39.0, 173.0, 129.0],
        [92.0, 200.0, 99.0],
        [170.0, 220.0, 50.0],
        [253.0, 231.0, 37.0],
    ];
    let seen = |z: f32| z.is_finite() && z > 0.0 && z < 0.999 * far;
    let (near, deep) = depth
        .iter()
        .filter(|&&z| seen(z))
        .fold((f32::INFINITY, f32::NEG_INFINITY), |(near, deep), &z| (near.min(z), deep.max(z)));
    let span = (deep / near).ln().max(1e-6);
    let mut rgb = Vec::with_capacity(3 * depth.len());
    for &z in depth {
        if !seen(z) {
            rgb.extend([0, 0, 0]);
            continue;
        }
        let place = (1.0 - (z / near).ln() / span).clamp(0.0, 1.0) * (ANCHORS.len() - 1) as f32;
        let below = (place as usize).min(ANCHORS.len() - 2);
        let share = place - below as f32;
        rgb.extend(ANCHORS[below].iter().zip(ANCHORS[below + 1]).map(|(a, b)| (a + (b - a) * share).round() as u8));
    }
    rgb
}

/// Converts a segmentation image to distinct RGB colours. The background is black.
pub fn segmentation_in_colour(objects: &[[i32; 2]]) -> Vec<u8> {
    let mut rgb = Vec::with_capacity(3 * objects.len());
    for [_, index] in objects {
        rgb.extend(match u32::try_from(*index) {
            Err(_) => [0, 0, 0],
            // index 0 is the floor, which covers most of an image
            Ok(0) => [90, 90, 96],
            // multiples of the golden ratio give hues that are far apart
            Ok(index) => hue((index as f32 * 0.618_034).fract(), if index % 2 == 0 { 0.95 } else { 0.7 }),
        });
    }
    rgb
}

/// Returns a saturated colour. `turn` is the hue from 0 to 1.
fn hue(turn: f32, value: f32) -> [u8; 3] {
    let channel = |offset: f32| {
        let place = ((turn + offset).fract() * 6.0 - 3.0).abs() - 1.0;
        ((0.15 + 0.85 * place.clamp(0.0, 1.0)) * value * 255.0).round() as u8
    };
    [channel(0.0), channel(2.0 / 3.0), channel(1.0 / 3.0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: ImageSize = ImageSize { width: 3, height: 2 };

    #[test]
    fn depth_png_is_in_millimetres_and_zero_out_of_range() {
        let depth = [0.0, 0.0014, 1.2345, 65.535, 65.54, f32::INFINITY];
        let png = png_depth(SIZE, &depth).unwrap();
        let back = image::load_from_memory(&png).unwrap();
        assert_eq!(back.as_luma16().unwrap().as_raw()[..], [0, 1, 1235, 65_535, 0, 0]);
    }

    #[test]
    fn segmentation_png_is_the_index_plus_one() {
        let png = png_segmentation(SIZE, &[[-1, -1], [5, 0], [5, 7], [5, 65_534], [5, 65_535], [5, 1]]).unwrap();
        let back = image::load_from_memory(&png).unwrap();
        assert_eq!(back.as_luma16().unwrap().as_raw()[..], [0, 1, 8, 65_535, 0, 2]);
    }

    #[test]
    fn colour_png_reads_back_unchanged() {
        let rgb: Vec<u8> = (0..18).map(|i| i * 14).collect();
        assert_eq!(
            image::load_from_memory(&png_rgb(SIZE, &rgb).unwrap()).unwrap().as_rgb8().unwrap().as_raw()[..],
            rgb
        );
        assert!(png_rgb(SIZE, &rgb[1..]).unwrap_err().to_string().contains("17"));
        let far = depth_in_colour(&[1.0, 2.0, 4.0, 100.0, f32::NAN, 0.0], 100.0);
        assert!(far[0] > far[3] && far[9..] == [0; 9], "near is light and the background is black");
        let objects = segmentation_in_colour(&[[-1, -1], [5, 0], [5, 1], [5, 2], [5, 3], [5, 4]]);
        let colours: std::collections::BTreeSet<_> = objects.chunks(3).collect();
        assert_eq!(colours.len(), 6);
    }
}
