"""Blinking between two pictures, which several pages do: the script of its button."""

__all__ = ["BLINKING"]

BLINKING = r"""
  const blinking = (button, swap) => {
    const still = matchMedia("(prefers-reduced-motion: reduce)");
    let timer = null;
    const stop = () => {
      clearInterval(timer);
      timer = null;
      if (!still.matches) button.setAttribute("aria-pressed", "false");
    };
    const name = () => {
      stop();
      button.textContent = still.matches ? "Swap" : "Blink";
      if (still.matches) button.removeAttribute("aria-pressed");
    };
    button.addEventListener("click", () => {
      if (timer !== null) { stop(); return; }
      swap();
      if (still.matches) return;
      timer = setInterval(swap, 700);
      button.setAttribute("aria-pressed", "true");
    });
    still.addEventListener("change", name);
    name();
    return stop;
  };
"""
"""Script function that makes a button call `swap` again and again, or once a press where the system asks for
less motion. It returns a function that ends it."""
