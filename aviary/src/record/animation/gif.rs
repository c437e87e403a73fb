use std::io::Write;

use color_quant::NeuQuant;
use gif::{DisposalMethod, Encoder, Frame, Repeat};

use super::{Animation, check_time};
use crate::record::RecordError;
use crate::record::images::check;
use crate::vision::ImageSize;

/// An animated GIF that repeats forever. Frames are encoded as they are added.
///
/// Three properties keep files small: a pixel whose colour hardly changes keeps its value, frames share a palette
/// while it fits them, and colours are not dithered. The error of a pixel is at most the error of the palette and a
/// difference that is hardly visible.
pub struct GifAnimation<W: Write> {
    target: Target<W>,
    size: ImageSize,
    /// Duration of a frame, 1/100 s, the time unit of GIF.
    delay: f64,
    frames: u32,
    palette: Option<Palette>,
    /// Pixels that a viewer shows now, RGB.
    shown: Vec<u8>,
    indices: Vec<u8>,
}

/// Output of the animation. The header of a GIF needs the palette of the first frame, so the encoder starts with that
/// frame.
enum Target<W: Write> {
    Waiting(W),
    Started(Encoder<W>),
    /// State during the start of the encoder, and after a failed start.
    Failed,
}

/// Palette index of pixels that keep their value. Palettes have one colour less than GIF allows.
const UNCHANGED: u8 = 255;

/// Squared RGB distance below which a pixel keeps its value: four steps of 256 in every channel.
const INVISIBLE: u32 = 3 * 4 * 4;

/// Increase of the mean squared distance from the palette above which a frame gets its own palette, in squared steps
/// of 256.
const MAX_ERROR_INCREASE: f64 = 12.0;

/// Increase of the fraction of pixels farther than [`FAR`] from the palette above which a frame gets its own palette.
const MAX_FAR_INCREASE: f64 = 5e-4;

/// Error of an encoder that could not be created.
const NOT_STARTED: &str = "the encoder could not be started";

/// Squared RGB distance above which two colours count as different: 20 steps of 256 in every channel.
const FAR: u32 = 3 * 20 * 20;

impl<W: Write> GifAnimation<W> {
    /// Creates an animation with a time per frame in s. The time is limited to 20 ms to 60 s and rounded to 10 ms
    /// such that the total duration stays correct.
    ///
    /// # Errors
    /// [`RecordError::Image`] for a size that GIF does not support, and [`RecordError::FrameTime`] for an invalid
    /// time.
    pub fn new(target: W, size: ImageSize, seconds_per_frame: f64) -> Result<Self, RecordError> {
        sides(size)?;
        check_time(seconds_per_frame)?;
        // viewers show times below 2/100 s as 1/10 s
        let delay = (seconds_per_frame * 100.0).clamp(2.0, 6000.0);
        let (shown, indices) = (Vec::new(), vec![0; size.pixels()]);
        Ok(Self { target: Target::Waiting(target), size, delay, frames: 0, palette: None, shown, indices })
    }

    /// Completes the animation and returns the target.
    ///
    /// # Errors
    /// [`RecordError::Animation`] if the target cannot be written.
    pub fn finish(self) -> Result<W, RecordError> {
        match self.target {
            Target::Waiting(target) => Ok(target),
            Target::Started(encoder) => Ok(encoder.into_inner()?),
            Target::Failed => Err(RecordError::Animation(std::io::Error::other(NOT_STARTED).into())),
        }
    }

    fn encoder(&mut self, palette: &[u8]) -> Result<&mut Encoder<W>, RecordError> {
        if matches!(self.target, Target::Waiting(_))
            && let Target::Waiting(target) = std::mem::replace(&mut self.target, Target::Failed)
        {
            let [width, height] = sides(self.size)?;
            let mut encoder = Encoder::new(target, width, height, palette)?;
            encoder.set_repeat(Repeat::Infinite)?;
            self.target = Target::Started(encoder);
        }
        match &mut self.target {
            Target::Started(encoder) => Ok(encoder),
            _ => Err(RecordError::Animation(std::io::Error::other(NOT_STARTED).into())),
        }
    }

    /// Selects a colour for every pixel and updates the shown image. Returns the smallest rectangle (left, top,
    /// right, bottom) that contains all changes.
    fn choose(&mut self, rgb: &[u8], palette: &mut Palette) -> [usize; 4] {
        let width = self.size.width as usize;
        let mut changed = [usize::MAX, usize::MAX, 0, 0];
        let first = self.shown.is_empty();
        self.shown.resize(rgb.len(), 0);
        let pixels = rgb.chunks_exact(3).zip(self.shown.chunks_exact_mut(3)).zip(&mut self.indices);
        for (place, ((wanted, shown), index)) in pixels.enumerate() {
            let nearest = palette.nearest(wanted);
            let best = palette.colour(nearest);
            if !first && distance(shown, wanted) <= distance(best, wanted) + INVISIBLE {
                *index = UNCHANGED;
                continue;
            }
            *index = nearest;
            shown.copy_from_slice(best);
            let (x, y) = (place % width, place / width);
            changed = [changed[0].min(x), changed[1].min(y), changed[2].max(x + 1), changed[3].max(y + 1)];
        }
        // a GIF frame has at least one pixel
        if changed[2] == 0 { [0, 0, 1, 1] } else { changed }
    }
}

impl<W: Write> Animation for GifAnimation<W> {
    fn frame(&mut self, rgb: &[u8]) -> Result<(), RecordError> {
        check(self.size, rgb.len(), 3)?;
        let known = self.palette.take().and_then(|mut palette| {
            let (error, far) = palette.error(rgb);
            let poor = error - palette.made_for.0 > MAX_ERROR_INCREASE || far - palette.made_for.1 > MAX_FAR_INCREASE;
            (!poor).then_some(palette)
        });
        let mut palette = known.unwrap_or_else(|| Palette::of(rgb, self.frames));
        let [left, top, right, bottom] = self.choose(rgb, &mut palette);
        let row = self.size.width as usize;
        let buffer: Vec<u8> =
            (top..bottom).flat_map(|y| &self.indices[y * row + left..y * row + right]).copied().collect();
        // rounding errors of frame times cancel out over the animation
        let end = |frames: u32| (f64::from(frames) * self.delay).round();
        let delay = (end(self.frames + 1) - end(self.frames)) as u16;
        let frame = Frame {
            delay,
            dispose: DisposalMethod::Keep,
            transparent: Some(UNCHANGED),
            left: left as u16,
            top: top as u16,
            width: (right - left) as u16,
            height: (bottom - top) as u16,
            // the header holds the first palette
            palette: (palette.since > 0).then(|| palette.colours.clone()),
            buffer: buffer.into(),
            ..Frame::default()
        };
        self.encoder(&palette.colours)?.write_frame(&frame)?;
        self.palette = Some(palette);
        self.frames += 1;
        Ok(())
    }
}

/// Palette of 255 colours and one index for unchanged pixels.
struct Palette {
    colours: Vec<u8>,
    /// Known nearest palette colours, for colours with `BITS` bits per channel.
    nearest: Vec<Option<u8>>,
    /// Mean squared distance of the frame that the palette was created for, and the fraction of its pixels far from
    /// every colour.
    made_for: (f64, f64),
    /// Index of the frame that the palette was created for.
    since: u32,
}

impl Palette {
    /// Bits per channel of the lookup table of nearest colours.
    const BITS: u32 = 6;

    fn of(rgb: &[u8], frame: u32) -> Self {
        // histogram over the first five bits of each channel: counts and channel sums
        let mut bins = vec![(0_u64, [0_u64; 3]); 1 << 15];
        for pixel in rgb.chunks_exact(3) {
            let bin = pixel.iter().fold(0, |bin, &x| bin << 5 | usize::from(x >> 3));
            let (count, sums) = &mut bins[bin];
            *count += 1;
            sums.iter_mut().zip(pixel).for_each(|(sum, &x)| *sum += u64::from(x));
        }
        // weights grow with the square root of the count, so that a large floor leaves colours for thin lines and
        // small lights
        let mut rgba = Vec::new();
        for (count, sums) in bins.into_iter().filter(|(count, _)| *count > 0) {
            let [r, g, b] = sums.map(|sum| (sum / count) as u8);
            for _ in 0..((count as f64).sqrt().ceil() as usize).min(64) {
                rgba.extend([r, g, b, 255]);
            }
        }
        // the quantizer trains on single pixels and needs a minimum number of them
        let whole = rgba.len();
        while rgba.len() < 4 * 8192 {
            rgba.extend_from_within(..whole);
        }
        let mut colours = NeuQuant::new(1, UNCHANGED.into(), &rgba).color_map_rgb();
        colours.resize(3 * 256, 0);
        let mut palette =
            Self { colours, nearest: vec![None; 1 << (3 * Self::BITS)], made_for: (0.0, 0.0), since: frame };
        palette.made_for = palette.error(rgb);
        palette
    }

    fn colour(&self, index: u8) -> &[u8] {
        &self.colours[3 * usize::from(index)..][..3]
    }

    fn nearest(&mut self, colour: &[u8]) -> u8 {
        let place = colour.iter().fold(0, |place, &x| place << Self::BITS | usize::from(x >> (8 - Self::BITS)));
        if let Some(index) = self.nearest[place] {
            return index;
        }
        let colours = self.colours.chunks_exact(3).take(UNCHANGED.into()).enumerate();
        let index = colours.min_by_key(|(_, known)| distance(known, colour)).map_or(0, |(index, _)| index as u8);
        self.nearest[place] = Some(index);
        index
    }

    /// Returns the mean squared distance of a frame from the palette, and the fraction of its pixels far from every
    /// colour.
    fn error(&mut self, rgb: &[u8]) -> (f64, f64) {
        let (mut sum, mut far) = (0.0, 0.0);
        for pixel in rgb.chunks_exact(3) {
            let nearest = self.nearest(pixel);
            let distance = distance(self.colour(nearest), pixel);
            sum += f64::from(distance);
            far += f64::from(u8::from(distance > FAR));
        }
        let count = (rgb.len() / 3).max(1) as f64;
        (sum / count, far / count)
    }
}

/// Returns the squared distance of two colours.
fn distance(a: &[u8], b: &[u8]) -> u32 {
    a.iter().zip(b).map(|(&a, &b)| u32::from(a.abs_diff(b)).pow(2)).sum()
}

fn sides(size: ImageSize) -> Result<[u16; 2], RecordError> {
    match (u16::try_from(size.width), u16::try_from(size.height)) {
        (Ok(width), Ok(height)) if width > 0 && height > 0 => Ok([width, height]),
        _ => Err(RecordError::Image { size, got: 0, expected: size.pixels() }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the frames as a viewer shows them, RGB, with their durations.
    fn shown(bytes: &[u8], size: ImageSize) -> Vec<(u16, Vec<u8>)> {
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let mut decoder = options.read_info(bytes).unwrap();
        let mut screen = vec![0; 3 * size.pixels()];
        let mut frames = Vec::new();
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            for (place, pixel) in frame.buffer.chunks_exact(4).enumerate().filter(|(_, pixel)| pixel[3] > 0) {
                let (x, y) = (place % usize::from(frame.width), place / usize::from(frame.width));
                let at = (usize::from(frame.top) + y) * size.width as usize + usize::from(frame.left) + x;
                screen[3 * at..][..3].copy_from_slice(&pixel[..3]);
            }
            frames.push((frame.delay, screen.clone()));
        }
        frames
    }

    #[test]
    fn a_gif_keeps_its_frames_and_its_duration() {
        const SIZE: ImageSize = ImageSize { width: 3, height: 2 };
        let mut animation = GifAnimation::new(Vec::new(), SIZE, 1.0 / 24.0).unwrap();
        animation.frame(&[255; 18]).unwrap();
        assert!(animation.frame(&[0; 17]).is_err());
        for _ in 0..5 {
            animation.frame(&[0; 18]).unwrap();
        }
        let frames = shown(&animation.finish().unwrap(), SIZE);
        assert_eq!((frames.len(), frames[0].1[0], frames[1].1[0]), (6, 255, 0));
        // // six frames of 1/24 s take 0.25 s
        assert_eq!(frames.iter().map(|(delay, _)| delay).sum::<u16>(), 25);
    }

    #[test]
    fn frames_match_their_images_and_unchanged_pixels_cost_little() {
        const SIZE: ImageSize = ImageSize { width: 64, height: 48 };
        // // a colour gradient behind a moving disc, which turns to a new colour half-way
        let image = |t: usize| -> Vec<u8> {
            let pixel = |place: usize| {
                let (x, y) = (place % 64, place / 64);
                let disc = (x as i32 - 10 - t as i32).pow(2) + (y as i32 - 24).pow(2) < 60;
                match (disc, t > 15) {
                    (true, false) => [20, 200, 40],
                    (true, true) => [250, 10, 30],
                    _ => [2 * x as u8, 3 * y as u8, 90],
                }
            };
            (0..64 * 48).flat_map(pixel).collect()
        };
        let mut animation = GifAnimation::new(Vec::new(), SIZE, 0.04).unwrap();
        (0..30).for_each(|t| animation.frame(&image(t)).unwrap());
        let bytes = animation.finish().unwrap();
        let frames = shown(&bytes, SIZE);
        assert_eq!(frames.len(), 30);
        for (t, (_, frame)) in frames.iter().enumerate() {
            let wanted = image(t);
            let errors: Vec<_> =
                frame.chunks_exact(3).zip(wanted.chunks_exact(3)).map(|(a, b)| distance(a, b)).collect();
            let mean = f64::from(errors.iter().sum::<u32>()) / errors.len() as f64;
            assert!(mean < 60.0, "frame {t}: mean {mean}");
            assert!(errors.iter().all(|&error| error < 3 * 40 * 40), "frame {t}: {:?}", errors.iter().max());
        }
        // // 30 complete frames would take 30 times the size of the first one
        let mut still = GifAnimation::new(Vec::new(), SIZE, 0.04).unwrap();
        still.frame(&image(0)).unwrap();
        let first = still.finish().unwrap().len();
        assert!(4 * bytes.len() < 30 * first, "{} against {first}", bytes.len());
    }

    #[test]
    fn invalid_sizes_are_errors_and_an_animation_without_frames_is_empty() {
        for size in [(0, 4), (4, 0), (70_000, 4)] {
            assert!(GifAnimation::new(Vec::new(), ImageSize { width: size.0, height: size.1 }, 0.1).is_err());
        }
        let empty = GifAnimation::new(Vec::new(), ImageSize { width: 2, height: 2 }, 0.1).unwrap();
        assert!(empty.finish().unwrap().is_empty());
    }
}
