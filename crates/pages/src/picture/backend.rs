//! Plots on a [`Canvas`]: a backend for plotters.

use std::convert::Infallible;

use plotters_backend::{
    BackendColor, BackendCoord, BackendTextStyle, DrawingBackend, DrawingErrorKind,
    text_anchor::{HPos, VPos},
};

use super::canvas::{Canvas, PLOT_FONT};
use eddy_frames::palette::WHITE;

type Drawn<T = ()> = Result<T, DrawingErrorKind<Infallible>>;

/// Draws plots on a canvas.
pub(crate) struct CanvasBackend<'a>(pub(crate) &'a mut Canvas);

impl DrawingBackend for CanvasBackend<'_> {
    type ErrorType = Infallible;

    fn get_size(&self) -> (u32, u32) {
        (self.0.width() as u32, self.0.height() as u32)
    }

    fn ensure_prepared(&mut self) -> Drawn {
        Ok(())
    }

    fn present(&mut self) -> Drawn {
        Ok(())
    }

    fn draw_pixel(&mut self, (x, y): BackendCoord, color: BackendColor) -> Drawn {
        let (red, green, blue) = color.rgb;
        self.0.blend([x, y], [red, green, blue], color.alpha as f32);
        Ok(())
    }

    fn draw_text<S: BackendTextStyle>(
        &mut self,
        text: &str,
        style: &S,
        (x, y): BackendCoord,
    ) -> Drawn {
        let text = ascii(text);
        let (red, green, blue) = style.color().rgb;
        let (width, height) = Canvas::size_of(&text, PLOT_FONT);
        let mut image = Canvas::new(width, height);
        image.text_in(PLOT_FONT, &text, 0, 0, [red, green, blue]);
        let (width, height) = (width as i32, height as i32);
        let left = match style.anchor().h_pos {
            HPos::Left => 0,
            HPos::Center => -width / 2,
            HPos::Right => -width,
        };
        let top = match style.anchor().v_pos {
            VPos::Top => 0,
            VPos::Center => -height / 2,
            VPos::Bottom => -height,
        };
        for (index, &pixel) in image.pixels().iter().enumerate().filter(|(_, p)| **p != WHITE) {
            let (column, row) = (index as i32 % width, index as i32 / width);
            let (dx, dy) = style.transform().transform(left + column, top + row);
            self.0.blend([x + dx, y + dy], pixel, 1.0);
        }
        Ok(())
    }

    fn estimate_text_size<S: BackendTextStyle>(&self, text: &str, _: &S) -> Drawn<(u32, u32)> {
        let (width, height) = Canvas::size_of(&ascii(text), PLOT_FONT);
        Ok((width as u32, height as u32))
    }
}

/// A label without superscripts, which the font lacks: `10⁻³` as `1e-3`.
fn ascii(label: &str) -> String {
    const SUPERSCRIPTS: [char; 10] = ['⁰', '¹', '²', '³', '⁴', '⁵', '⁶', '⁷', '⁸', '⁹'];
    let digit = |c: char| SUPERSCRIPTS.iter().position(|&superscript| superscript == c);
    let Some(exponent) = label.find(|c| c == '⁻' || digit(c).is_some()) else {
        return label.to_owned();
    };
    let mantissa = label[..exponent].trim_end_matches("10").trim_end_matches('·');
    let mantissa = if mantissa.is_empty() { "1" } else { mantissa };
    let exponent = label[exponent..].chars().map(|c| match digit(c) {
        Some(digit) => digit.to_string(),
        None => "-".to_owned(),
    });
    format!("{mantissa}e{}", exponent.collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::ascii;

    #[test]
    fn labels_have_no_superscripts() {
        for (label, expected) in
            [("0.05", "0.05"), ("10⁻³", "1e-3"), ("5·10⁻¹²", "5e-12"), ("10⁴", "1e4")]
        {
            assert_eq!(ascii(label), expected);
        }
    }
}
