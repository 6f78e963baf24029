// The digits of a PIN on the screen: for a panel without a keyboard.

const pin = document.getElementById("pin");

document.getElementById("digits").addEventListener("click", (event) => {
  const digit = event.target.closest("[data-digit]")?.dataset.digit;
  if (digit === undefined) return;
  pin.value = digit ? (pin.value + digit).slice(0, pin.maxLength) : pin.value.slice(0, -1);
});
